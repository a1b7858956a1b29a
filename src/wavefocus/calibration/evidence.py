"""Limits that several verdicts share; docs/reference/constants.md says what half and double of each would do."""

MOST = 0.5
"""By definition: what explains, holds or leaves more than half."""
CERTAIN_SHARE = 0.95
"""A cause is certain that explains this share of the excess: the contract of `verify.json`, section 6."""
SIGMAS = 5.0
"""Standard errors by which noise is not exceeded: one in two million (normal statistics, two sides)."""
HEARD_DB = 6.0
"""Signal-to-noise ratio from which on a signal is heard: with nearer noise its level is only a bound (ISO 3744)."""
CLEAR_DB = 15.0
"""Signal-to-noise ratio from which on noise needs no correction (ISO 3744)."""
SOUND = 0.01
"""Error, relative to the response, of a row that is as a bank's should be: what a leak may make of the median row."""
TOLERANCE = 0.05
"""Error that a verification allows by default (`verify --error`); smaller changes are not named."""
SILENT = 0.1
"""Factor below which an actuator is silent: -20 dB leave an error of 90 % of its response."""
ROW_CHANGE = 0.5
"""Level from which on a single row is called wrong: 6 dB, twice or half."""
SEEN_SHARE = 0.8
"""Part of a change from which on it counts, or its cause is named: noise, drift and errors of predictions may take the
rest."""
MAJORITY = 3
"""The fewest of which one may be wrong without moving their median."""
