import numpy as np
import pytest
from scipy import integrate

from calibration.errors import CalibrationError
from calibration.lamp import Lamp

DOWN = np.array([0.0, 0.0, -1.0])


def lamp(**changes):
    settings = {
        "position": np.array([0.0, 0.0, 500.0]),
        "axis": DOWN,
        "intensity": np.array([1.0, 2.0, 3.0]),
        "exponent": 2.0,
    }
    return Lamp(**(settings | changes))


def test_light_falls_with_the_square_of_the_distance_on_the_axis():
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 250.0]])
    near_over_far = lamp().irradiance(points)[1] / lamp().irradiance(points)[0]
    np.testing.assert_allclose(near_over_far, 4.0)


def test_flux_through_a_plane_is_that_of_the_lobe_whatever_the_distance():
    # ∫ I cosᵐ over the half-sphere is 2π I / (m + 1), through any plane below the lamp.
    def ring(radius, height):
        e = lamp(position=np.array([0.0, 0.0, height])).irradiance(np.array([radius, 0.0, 0.0]))
        cosine = height / np.hypot(radius, height)
        return 2 * np.pi * radius * e[0] * cosine

    for height in (10.0, 500.0):
        flux = integrate.quad(ring, 0.0, np.inf, args=(height,))[0]
        np.testing.assert_allclose(flux, 2 * np.pi / 3, rtol=1e-6)


def test_directions_are_unit_and_lead_to_the_lamp():
    points = np.random.default_rng(0).uniform(-200, 200, (4, 5, 3))
    towards = lamp().directions(points)
    np.testing.assert_allclose(np.linalg.norm(towards, axis=-1), 1.0)
    np.testing.assert_allclose(np.cross(towards, lamp().position - points), 0.0, atol=1e-9)


def test_nothing_behind_the_lamp_is_lit():
    assert (lamp().irradiance(np.array([0.0, 0.0, 600.0])) == 0.0).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"axis": np.array([0.0, 0.0, -2.0])},
        {"position": np.array([0.0, np.nan, 1.0])},
        {"intensity": np.array([1.0, 0.0, 1.0])},
        {"exponent": -1.0},
        {"exponent": np.nan},
    ],
    ids=["axis", "position", "intensity", "negative exponent", "NaN exponent"],
)
def test_what_is_no_lamp_is_refused(changes):
    with pytest.raises(CalibrationError, match="a lamp's"):
        lamp(**changes)
