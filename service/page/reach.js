// Where the fiducial can go: the travel of two axes, as the calibration sees it in the slice.

import { s } from "./dom.js";

// The corners (row, col) mm from where the fiducial is now; null where that is not known.
export function reachable({ belief, robot, guide, measurement }) {
  const perAxis = belief?.calibration?.per_axis ?? {};
  const axes = Object.keys(perAxis);
  if (guide || axes.length !== 2 || !measurement?.patient_mm || measurement.lost) return null;
  if (!axes.every((axis) => axis in robot.positions_um && robot.travel_um[axis])) return null;
  const ways = axes.map((axis) => robot.travel_um[axis].map((limit) => perAxis[axis].column_mm.map((mm) => mm * (limit - robot.positions_um[axis]) / 1000)));
  const [[a, b], [c, d]] = ways;
  return [[a, c], [b, c], [b, d], [a, d]].map(([one, other]) => one.map((value, k) => value + other[k]));
}

// Drawn while a target is picked, around the fiducial at (x, y) mm of the slice.
export function reachOutline([x, y], corners) {
  return s("polygon", { id: "reach", points: corners.map(([row, col]) => `${x + col},${y + row}`).join(" "), class: "thin c-plan dash", fill: "none" });
}
