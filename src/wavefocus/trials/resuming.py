"""Where a participant's trials go on: after the answers that are stored, if they are of this very experiment."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from wavefocus.storage.errors import InputError
from wavefocus.trials.answers import Row
from wavefocus.trials.design import TrialsDesign
from wavefocus.trials.order import FixedOrder, Order


@dataclass(frozen=True, slots=True)
class Experiment:
    """An experiment; SHA-256 of each stimulus by its name, and of the bank, once they are prepared."""

    design: TrialsDesign
    stimulus_sha256: Mapping[str, str] = field(default_factory=dict)
    bank_sha256: str | None = None


def order_of(design: TrialsDesign, participant: str) -> Order:
    """Make the order of a participant, at its first trial; give it the answers that are stored to go on."""
    if design.config.adaptive is None:
        return FixedOrder(design, participant)
    from wavefocus.trials.adaptive import AdaptiveOrder

    return AdaptiveOrder(design, participant)


def resume_sequence(experiment: Experiment, participant: str, rows: Sequence[Row]) -> tuple[Order, int]:
    """Make the order of a participant, at the trial after those that are answered, and count these.

    rows: Answers of all participants.

    Raises InputError: the participant is complete, has a code that differs from another's only in case,
    or has answered trials of another trials file, bank or order.
    """
    design, order, done = experiment.design, order_of(experiment.design, participant), 0
    for row in rows:
        if row.participant != participant:
            if row.participant.casefold() == participant.casefold():
                raise InputError(f"participant is {participant}, and {row.participant} has answers: use another code")
            continue
        trial = order.next_trial()
        where = f"participant {participant} answered trial {row.trial}"
        for what, then, now in (
            (f"{design.file}, the trials file,", row.trials_sha256, design.sha256),
            ("the bank", row.bank_sha256, experiment.bank_sha256),
            (f"the stimulus {row.stimulus}", row.stimulus_sha256, experiment.stimulus_sha256.get(row.stimulus)),
        ):
            if now is not None and then != now:
                raise InputError(
                    f"{where} before {what} was changed: put it back, or begin with another code or folder"
                )
        if trial is None or (trial.number, trial.stimulus) != (row.trial, row.stimulus):
            expected = "none" if trial is None else f"trial {trial.number}, {trial.stimulus}"
            raise InputError(
                f"{where}, {row.stimulus}, where the order has {expected}: the answers were changed, or stored by"
                " another version; begin with another code"
            )
        order.answered(row.answer)
        done += 1
    if order.next_trial() is None:
        raise InputError(f"participant {participant} is complete: {done} trials are answered; use another code")
    return order, done
