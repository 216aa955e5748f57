"""What a fitted disc leaves of a frame."""

import numpy as np
import pytest

from sr_engine.psf import Psf
from sr_engine.residual import residual_image
from sr_engine.simulate import render_disc

PSF = Psf()
CENTRE_PX, RADIUS_PX = (30.3, 25.8), 4.2


def test_nothing_but_noise_is_left_of_a_disc_and_nothing_is_shown_far_from_it():
    noise = np.random.default_rng(1).normal(0.0, 2.0, (64, 64))
    frame = render_disc((64, 64), CENTRE_PX, RADIUS_PX, 100.0, 10.0, PSF) + noise
    left = residual_image(frame, CENTRE_PX, RADIUS_PX, PSF)
    near = left != 0
    assert left[near].std() == pytest.approx(2.0, rel=0.15)
    assert np.abs(left).max() < 10
    assert near.sum() < 23**2


def test_a_hole_that_the_disc_lacks_stays_dark():
    frame = render_disc((64, 64), CENTRE_PX, RADIUS_PX, 100.0, 0.0, PSF)
    frame -= render_disc((64, 64), CENTRE_PX, 1.5, 60.0, 0.0, PSF)
    left = residual_image(frame, CENTRE_PX, RADIUS_PX, PSF)
    assert left[30, 26] < -20
