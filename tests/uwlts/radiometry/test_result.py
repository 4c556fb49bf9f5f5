"""Text of a result."""

from uwlts.radiometry.result import format_value


def test_values_have_the_digits_of_their_uncertainty():
    assert format_value(0.83214, 0.0143) == "0.832 ± 0.014"
    assert format_value(1234.5, 25.0) == "1234 ± 25"
    assert format_value(1.0, 0.0) == "1"
