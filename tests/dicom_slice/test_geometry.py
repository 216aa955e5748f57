"""Pixel index <-> patient millimetres, on non-square slices with unequal spacing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dicom_slice.geometry import GeometryError, SliceGeometry

# A coronal slice as a scanner writes it: columns run to the patient's left, rows to the feet.
CORONAL = SliceGeometry.from_header([-90, 12, 110], [1, 0, 0, 0, 0, -1], [1.5, 0.75], (160, 240))


def test_pixel_zero_has_its_centre_at_the_image_position() -> None:
    np.testing.assert_allclose(CORONAL.patient_from_pixel((0, 0)), (-90, 12, 110))


def test_the_row_index_runs_along_the_second_triple_with_the_first_spacing() -> None:
    np.testing.assert_allclose(CORONAL.patient_from_pixel((10, 0)), (-90, 12, 95))
    np.testing.assert_allclose(CORONAL.patient_from_pixel((0, 10)), (-82.5, 12, 110))


def test_a_coronal_slice_faces_the_antero_posterior_axis() -> None:
    assert CORONAL.angle_to_coronal_deg == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose(np.abs(CORONAL.normal), (0, 1, 0))
    axial = SliceGeometry.from_header([0, 0, 0], [1, 0, 0, 0, 1, 0], [1, 1], (4, 5))
    assert axial.angle_to_coronal_deg == pytest.approx(90)


@given(st.integers(0, 2**32 - 1))
def test_patient_and_pixel_coordinates_are_inverse_in_any_oblique_slice(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    orientation = np.concatenate([q[:, 0], q[:, 1]])
    spacing = rng.uniform(0.3, 3, 2)
    oblique = SliceGeometry.from_header(rng.uniform(-200, 200, 3), orientation, spacing, (30, 50))
    points = rng.uniform(-10, 60, (7, 2))
    offset = rng.uniform(-20, 20)
    mm = oblique.patient_from_pixel(points) + offset * oblique.normal
    back, out_of_plane = oblique.pixel_from_patient(mm)
    np.testing.assert_allclose(back, points, atol=1e-9)
    np.testing.assert_allclose(out_of_plane, offset, atol=1e-9)


@pytest.mark.parametrize("factor", [1, 2, 3, 4])
def test_dividing_the_pixels_keeps_the_outer_edges(factor: int) -> None:
    fine = CORONAL.finer_grid(factor)
    corners = np.array([(-0.5, -0.5), (159.5, 239.5)])
    fine_corners = np.array([(-0.5, -0.5), (160 * factor - 0.5, 240 * factor - 0.5)])
    np.testing.assert_allclose(
        fine.patient_from_pixel(fine_corners), CORONAL.patient_from_pixel(corners), atol=1e-9
    )


def test_an_interlaced_grid_keeps_its_first_centre() -> None:
    fine = CORONAL.finer_grid(2, origin_px=(0.0, 0.0))
    np.testing.assert_allclose(
        fine.patient_from_pixel((20, 40)), CORONAL.patient_from_pixel((10, 20))
    )


@pytest.mark.parametrize(
    ("orientation", "spacing", "error"),
    [
        ([1, 0, 0, 0, 1], [1, 1], GeometryError),
        ([1, 0, 0, 1, 0, 0], [1, 1], GeometryError),
        ([2, 0, 0, 0, 1, 0], [1, 1], GeometryError),
        ([1, 0, 0, 0, np.nan, 0], [1, 1], GeometryError),
        ([1, 0, 0, 0, 1, 0], [1, 0], GeometryError),
        ([1, 0, 0, 0, 1, 0], [-1, 1], GeometryError),
    ],
)
def test_an_impossible_geometry_is_refused(
    orientation: list[float], spacing: list[float], error: type[Exception]
) -> None:
    with pytest.raises(error):
        SliceGeometry.from_header([0, 0, 0], orientation, spacing, (4, 5))
