"""What the commands read alike: numbers with their standard deviations, names of transports."""

import pytest

import oceaninv as oi
from fitting.commands.shared_options import known_values, number_with_sd, transport_class


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("5", (5.0, None)),
        ("5+-1", (5.0, 1.0)),
        ("5 +- 1", (5.0, 1.0)),
        ("5±1", (5.0, 1.0)),
        ("5+/-1", (5.0, 1.0)),
        ("5,5±0,25", (5.5, 0.25)),
        ("1e-3+-1e-4", (1e-3, 1e-4)),
        ("1.2E+1±.5", (12.0, 0.5)),
        ("", None),
        ("five", None),
        ("5+-", None),
        ("+-1", None),
        ("5+-0", None),
        ("0+-1", None),
        ("-5+-1", None),
        ("5+-1+-1", None),
        ("1,000.5", None),
        ("inf+-1", None),
        ("1e999+-1", None),
        ("5+-nan", None),
    ],
)
def test_a_number_and_its_deviation(text, found):
    assert number_with_sd(text) == found


def test_known_values_have_names():
    known = known_values(["cdom=0.12+-0.01", " Kd_490 = 0,09 ± 0,01"])
    assert known == {"cdom": (0.12, 0.01), "Kd_490": (0.09, 0.01)}
    for text in ("cdom", "cdom=0.12", "=0.12+-0.01", "0.12+-0.01", "cdom=0.12+-0.01 m-1"):
        with pytest.raises(ValueError, match=r"write name=value\+-sd, both positive"):
            known_values([text])


def test_transports_have_one_table_of_names():
    assert transport_class("two-stream") is oi.TwoStream
    assert transport_class("kd") is oi.KdTransport
    with pytest.raises(ValueError, match="'kd'; it must be one of two-stream, four-stream"):
        transport_class("kd", ("two-stream", "four-stream"))
