"""Units of responses and drives."""

import pytest

from wavefocus.storage.units import quantity, response_unit


@pytest.mark.parametrize(
    ("green", "drive", "response"),
    [
        ("m/s/V", "V", "m/s"), ("m/V", "V", "m"), ("(m/s)/V", "V", "m/s"), ("m s-1 V-1", "V", "m/s"),
        ("Pa per V", "V", "Pa"), ("Pa / V", "V", "Pa"), ("1/V", "V", "1"), ("V/V", "V", "V"), ("m/s/mV", "mV", "m/s"),
        ("m/s/A", "A", "m/s"), ("m·s⁻¹·V⁻¹", "volts", "m/s"), ("Pa", "V", "Pa"), ("m/s/mV", "V", "m/s/mV"),
        ("1", "V", "1"), ("", "1", "1"),
    ],
)  # fmt: skip
def test_a_response_then_has_the_unit_of_the_green_function_times_that_of_the_drive(green, drive, response):
    assert response_unit(green, drive) == response


def test_a_number_of_unit_1_then_stands_alone():
    assert (quantity("1", "1"), quantity("0.5", ""), quantity("0.5", "m/s")) == ("1", "0.5", "0.5 m/s")
