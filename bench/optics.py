"""From the camera's picture to a slice: colour plane, lens, scale, resampling.

Frames: the `picture` (rows, cols), the `sheet` (x along columns, y along rows, mm, origin in the
middle of the slice) and the `slice`. Pixel (0, 0) has its centre at (0.0, 0.0) everywhere.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from bench.config import CameraConfigError, CameraError
from bench.source import Picture, require_opencv
from room_config.camera import CameraConfig

Floats = NDArray[np.float64]
Colour = Literal["redness", "greenness", "blueness", "grey", "dark"]
_SUBSAMPLES = 4  # along each axis of a slice's pixel: it integrates over its area, as a sensor does
_FULL_SCALE = 255.0


def colour_plane(picture: Picture, colour: Colour) -> Floats:
    """(rows, cols), in which the circle is bright: one colour above the mean of the others."""
    channels = np.moveaxis(picture.astype(np.float64), -1, 0)
    if colour == "grey":
        return np.asarray(channels.mean(axis=0))
    if colour == "dark":
        return np.asarray(_FULL_SCALE - channels.mean(axis=0))
    chosen = ("redness", "greenness", "blueness").index(colour)
    others = [channel for index, channel in enumerate(channels) if index != chosen]
    return np.asarray(channels[chosen] - (others[0] + others[1]) / 2)


@dataclass(frozen=True, eq=False)
class Lens:
    """OpenCV's pinhole model of a camera over a flat sheet.

    picture_shape: (rows, cols). matrix (3, 3) and distortion (5,) are in x, y.
    normalized_from_sheet: (3, 3) homography from sheet mm (x, y) to undistorted coordinates.
    px_per_mm: near the middle. residual_px: rms of the board's corners.
    """

    picture_shape: tuple[int, int]
    matrix: Floats
    distortion: Floats
    normalized_from_sheet: Floats
    px_per_mm: float
    residual_px: float

    def to_json(self) -> dict[str, Any]:
        return {
            "picture_shape": list(self.picture_shape),
            "matrix": self.matrix.tolist(),
            "distortion": self.distortion.tolist(),
            "normalized_from_sheet": self.normalized_from_sheet.tolist(),
            "px_per_mm": self.px_per_mm,
            "residual_px": self.residual_px,
        }

    def picture_from_sheet(self, points_mm: Floats) -> Floats:
        """Sheet points (..., 2) in (x, y) mm -> picture points (..., 2) in (row, col)."""
        plain = np.concatenate([points_mm, np.ones((*points_mm.shape[:-1], 1))], axis=-1)
        mapped = plain @ self.normalized_from_sheet.T
        x, y = mapped[..., 0] / mapped[..., 2], mapped[..., 1] / mapped[..., 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        col = self.matrix[0, 0] * bent_x + self.matrix[0, 2]
        row = self.matrix[1, 1] * bent_y + self.matrix[1, 2]
        return np.stack([row, col], axis=-1)


def read_lens(path: Path) -> Lens:
    """Raises CameraConfigError for a file that is none."""
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
        lens = Lens(
            picture_shape=(int(table["picture_shape"][0]), int(table["picture_shape"][1])),
            matrix=np.array(table["matrix"], dtype=np.float64).reshape(3, 3),
            distortion=np.array(table["distortion"], dtype=np.float64).reshape(5),
            normalized_from_sheet=np.array(table["normalized_from_sheet"], float).reshape(3, 3),
            px_per_mm=float(table["px_per_mm"]),
            residual_px=float(table["residual_px"]),
        )
    except OSError as error:
        raise CameraConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise CameraConfigError(f"{path}: not a lens file ({error})") from None
    if not (np.isfinite(lens.matrix).all() and np.isfinite(lens.normalized_from_sheet).all()):
        raise CameraConfigError(f"{path}: a number is not finite")
    return lens


def learn_lens(pictures: list[Picture], squares: tuple[int, int], square_mm: float) -> Lens:
    """The lens from pictures of a checkerboard; the first one lies flat where the circle will be.

    squares: along rows and columns of the board. Raises CameraError where the board is not seen or
    the pictures do not tell the lens.
    """
    cv2 = require_opencv()
    inner = (squares[1] - 1, squares[0] - 1)  # corners (columns, rows), as OpenCV wants them
    board = np.zeros((inner[0] * inner[1], 3), np.float32)
    board[:, :2] = np.mgrid[: inner[0], : inner[1]].T.reshape(-1, 2) * square_mm
    shape = pictures[0].shape[:2]
    seen = []
    for number, picture in enumerate(pictures, start=1):
        if picture.shape[:2] != shape:
            raise CameraError(f"picture {number} of the board differs in size from the first")
        grey = np.ascontiguousarray(picture.mean(axis=2).round().astype(np.uint8))
        found, corners = cv2.findChessboardCornersSB(
            grey, inner, flags=cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
        )
        if found:
            seen.append(corners.reshape(-1, 2).astype(np.float32))
        elif number == 1:
            raise CameraError(
                f"the first picture shows no board of {squares[0]} x {squares[1]} squares; the "
                "whole board must be in view, with a white margin"
            )
    flags = cv2.CALIB_FIX_K3
    if len(seen) < 4:  # too few views to tell the focal length apart from the distance
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH
        flags |= cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_ZERO_TANGENT_DIST
    guess = np.array([[shape[1], 0, shape[1] / 2], [0, shape[1], shape[0] / 2], [0, 0, 1]], float)
    residual_px, matrix, distortion, _, _ = cv2.calibrateCamera(
        [board] * len(seen), seen, (shape[1], shape[0]), guess, np.zeros(5), flags=flags
    )
    straight = cv2.undistortPoints(seen[0][:, None, :], matrix, distortion).reshape(-1, 2)
    homography, _ = cv2.findHomography(board[:, :2].astype(np.float64), straight)
    lens = Lens(
        picture_shape=(int(shape[0]), int(shape[1])),
        matrix=np.asarray(matrix, dtype=np.float64),
        distortion=np.asarray(distortion, dtype=np.float64).reshape(-1)[:5],
        normalized_from_sheet=_squared_up(np.asarray(homography, dtype=np.float64)),
        px_per_mm=0.0,
        residual_px=float(residual_px),
    )
    steps = lens.picture_from_sheet(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    scale = float(np.sqrt(abs(np.linalg.det(steps[1:] - steps[0]))))
    if not (0 < scale < 1e4 and residual_px < 2.0):
        raise CameraError(
            f"the board's corners fit no lens model (rms {residual_px:.1f} px, "
            f"{scale:.3g} px per mm): take sharper pictures of a flat board"
        )
    return Lens(**{**vars(lens), "px_per_mm": scale})


def _squared_up(homography: Floats) -> Floats:
    """Turn the sheet: its axes along the picture, its origin on the optical axis."""
    inverse = np.linalg.inv(homography)
    middle = inverse @ np.array([0.0, 0.0, 1.0])
    right = inverse @ np.array([1e-3, 0.0, 1.0])
    down = inverse @ np.array([0.0, 1e-3, 1.0])
    origin, right, down = (point[:2] / point[2] for point in (middle, right, down))
    along = (right - origin) / np.linalg.norm(right - origin)
    across = np.array([-along[1], along[0]])
    across *= np.sign(across @ (down - origin))
    turn = np.eye(3)
    turn[:2, 0], turn[:2, 1], turn[:2, 2] = along, across, origin
    return np.asarray(homography @ turn)


class Resampler:
    """Cuts slices out of pictures of one size; the weights are worked out once."""

    def __init__(self, config: CameraConfig, picture_shape: tuple[int, int], lens: Lens | None):
        if lens is None and config.sensor_px_per_mm is None:
            raise CameraConfigError(
                "the scale is unknown: give camera.sensor_px_per_mm, or camera.lens_file "
                "(`autospine camera --board PICTURES`)"
            )
        if lens is not None and lens.picture_shape != picture_shape:
            raise CameraConfigError(
                f"the lens file is for pictures of {lens.picture_shape[1]} x "
                f"{lens.picture_shape[0]} pixels, the camera gives {picture_shape[1]} x "
                f"{picture_shape[0]}"
            )
        self.shape = config.shape
        points = _sheet_points(config.shape, config.pixel_mm)
        middle = config.centre_sensor_px or tuple((np.array(picture_shape) - 1) / 2)
        if lens is None:
            assert config.sensor_px_per_mm is not None
            where = points[..., ::-1] * config.sensor_px_per_mm + np.array(middle)
        else:
            offset_mm = sheet_of(lens, np.array(middle, dtype=np.float64))
            where = lens.picture_from_sheet(points + offset_mm)
        low, high = where.min(axis=(0, 1)), where.max(axis=(0, 1))
        if not (low > -0.5).all() or not (high < np.array(picture_shape) - 0.5).all():
            rows, cols = config.shape
            raise CameraConfigError(
                f"a slice of {rows * config.pixel_mm:g} x {cols * config.pixel_mm:g} mm does not "
                "fit in the picture; make camera.shape smaller or raise the camera"
            )
        self._where = np.moveaxis(where, -1, 0)

    def __call__(self, plane: Floats) -> Floats:
        """plane (rows, cols) of the picture -> slice (rows, cols)."""
        fine = map_coordinates(plane, self._where, order=3, mode="nearest")
        rows, cols = self.shape
        blocks = fine.reshape(rows, _SUBSAMPLES, cols, _SUBSAMPLES)
        return np.asarray(blocks.mean(axis=(1, 3)))


def _sheet_points(shape: tuple[int, int], pixel_mm: float) -> Floats:
    """Sheet points (x, y) mm of the subsamples, (rows*n, cols*n, 2), about the slice's middle."""
    along = [((np.arange(n * _SUBSAMPLES) + 0.5) / _SUBSAMPLES - n / 2) * pixel_mm for n in shape]
    y, x = np.meshgrid(along[0], along[1], indexing="ij")
    return np.stack([x, y], axis=-1)


def sheet_of(lens: Lens, point_px: Floats) -> Floats:
    """The sheet point (x, y) mm that a picture point (row, col) shows; Newton's method."""
    point = np.zeros(2)
    for _ in range(20):
        steps = lens.picture_from_sheet(point + np.array([[0, 0], [1e-3, 0], [0, 1e-3]]))
        jacobian = ((steps[1:] - steps[0]) / 1e-3).T
        change = np.linalg.solve(jacobian, point_px - steps[0])
        point = point + change
        if np.abs(change).max() < 1e-9:
            break
    return point
