"""A wrong name of an argument is answered by the nearest."""

import inspect

import numpy as np
import pytest

import fitting
from oceaninv.foundation.argument_names import names_checked

KINDS = (
    fitting.Profile, fitting.Bulk, fitting.Chart, fitting.Background, fitting.Pixels, fitting.Photo,
    fitting.fit_profile, fitting.fit_profiles, fitting.fit_photo, fitting.fit_photos,
    fitting.fit_bulk, fitting.fit_apparent,
)  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_argument_one_letter_off_is_found(kind):
    for name in inspect.signature(kind).parameters:
        if len(name) > 2:
            with pytest.raises(TypeError, match=f"{kind.__name__} has no argument '{name}s'; did"):
                kind(**{name + "s": None})


def test_names_that_are_near_none_list_all():
    @names_checked
    def light(depth, wavelength, *, Ed=1):
        return depth, wavelength, Ed

    assert light(1, wavelength=2, Ed=3) == (1, 2, 3)
    with pytest.raises(TypeError, match="light has no argument 'ed'; did you mean 'Ed'"):
        light(1, 2, ed=3)
    with pytest.raises(TypeError, match=r"'quux'; it has depth, wavelength, Ed\."):
        light(1, 2, quux=3)
    with pytest.raises(TypeError, match="missing 1 required positional argument"):
        light(1)


def test_right_names_are_handed_on():
    bulk = fitting.Bulk(wavelength=[450.0, 550.0], a=np.ones(2))
    assert bulk.names == ("a",)
