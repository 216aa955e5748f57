"""The template of an object whose poses are known only as far as each frame showed them.

A robot without encoders does not know its displacements to a fraction of a pixel, and a rough look
is all that there is before the first template. Image and displacements are therefore found in turn
from the same frames: a slightly wrong displacement only blurs the image, evenly, and the frames
fitted with that image say where they really are.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sr_engine.checks import checked_frames, checked_shifts
from sr_engine.errors import EngineError, ObjectAtBorderError, TemplateError
from sr_engine.localization import Localization
from sr_engine.localize import combined
from sr_engine.template.fit import TemplateFit
from sr_engine.template.learn import Template, learn_template

Array = NDArray[np.float64]

_DOUBTS_PX = (0.5, 0.0)  # of the places that each round begins with
_MOST_MOVED_PX = 2.0  # from where a place was said to be
_SEARCHED_PX = 1.0  # from farther away than this the template is looked for


def learn_from_places(
    frames: ArrayLike, places_px: ArrayLike, *, radius_px: tuple[float, float] | None = None
) -> tuple[Template, list[TemplateFit]]:
    """The image of the object that is at about places_px (M, 2) in frames (M, rows, cols), and
    where by that image it is in each of them.

    The reference pose is that of the first frame. Raises TemplateError where the frames do not
    show one and the same object at their places, and says which.
    """
    stack = checked_frames(frames)
    places = checked_shifts(places_px, len(stack))
    start = places
    for doubt_px in _DOUBTS_PX:
        template = learn_template(
            stack,
            places - places[0],
            radius_px=radius_px,
            centre_px=places[0],
            shift_sigma_px=doubt_px,
            shifts_are_fitted=True,
        )
        fits = [
            _fitted(template, number, frame, place + template.reference_px - places[0])
            for number, (frame, place) in enumerate(zip(stack, places, strict=True))
        ]
        places = np.array([fit.centre_px for fit in fits])
    moved = np.hypot(*(places - start - np.median(places - start, axis=0)).T)
    if not np.all(moved < _MOST_MOVED_PX):
        raise TemplateError(
            f"frame {int(np.argmax(moved))} shows the object {moved.max():.1f} px from where it "
            "was seen before: not one and the same object"
        )
    return template, fits


def _fitted(template: Template, number: int, frame: Array, start_px: Array) -> TemplateFit:
    try:
        return template.fit(frame, start_px=start_px)
    except EngineError as error:
        raise TemplateError(f"frame {number} does not fit the others: {error}") from error


def localize_by_template(
    frames: ArrayLike,
    shifts_px: ArrayLike | None,
    template: Template,
    *,
    start_px: ArrayLike | None = None,
    gate_px: float = _SEARCHED_PX,
    region: tuple[int, int, int, int] | None = None,
    shift_sigma_px: float = 0.0,
) -> Localization:
    """The template's object in frames of one size at known shifts, as `localize` does for a disc.

    start_px: where it is in the reference pose, to within gate_px; without, it is looked for in
    region (r0, c0, r1, c1) of the first frame, or everywhere. covariance_px2 is of the place
    as a displacement, against others by the same template; systematic_px is what is common to all
    of them. Raises an EngineError where a frame does not show the object, or the frames disagree
    with their shifts.
    """
    stack = checked_frames(frames)
    shifts = checked_shifts(shifts_px, len(stack))
    if start_px is None:
        start, gate_px = template.fit(stack[0], region=region).centre_px - shifts[0], _SEARCHED_PX
    else:
        start = np.asarray(start_px, float)
    fits = [
        _fit_near(template, frame, start + shift, gate_px)
        for frame, shift in zip(stack, shifts, strict=True)
    ]
    return combined(
        fits, shifts, template.radius_px, shift_sigma_px,
        method="template", systematic_px=template.systematic_px,
    )  # fmt: skip


def _fit_near(template: Template, frame: Array, near_px: Array, gate_px: float) -> TemplateFit:
    if gate_px <= _SEARCHED_PX:
        return template.fit(frame, start_px=near_px)
    reach = gate_px + 1
    low = np.maximum(np.floor(near_px - reach), 0).astype(int)
    high = np.minimum(np.ceil(near_px + reach) + 1, frame.shape).astype(int)
    if not np.all(high > low):
        raise ObjectAtBorderError(
            f"row {near_px[0]:.0f}, col {near_px[1]:.0f}, where the object is looked for, lies "
            "outside the frame"
        )
    return template.fit(frame, region=(int(low[0]), int(low[1]), int(high[0]), int(high[1])))
