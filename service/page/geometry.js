// Where pixels are in the patient (LPS mm), the same convention as dicom_slice/geometry.py:
// pixel (0, 0) has its centre at (0, 0); row_direction is where the row index grows.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export function patientFromPixel(geometry, [row, col]) {
  const [betweenRows, betweenCols] = geometry.spacing_mm;
  return geometry.position_mm.map(
    (value, k) =>
      value + row * betweenRows * geometry.row_direction[k] + col * betweenCols * geometry.col_direction[k],
  );
}

export function pixelFromPatient(geometry, pointMm) {
  const from = pointMm.map((value, k) => value - geometry.position_mm[k]);
  return [
    dot(from, geometry.row_direction) / geometry.spacing_mm[0],
    dot(from, geometry.col_direction) / geometry.spacing_mm[1],
  ];
}

const LETTERS = [["L", "R"], ["P", "A"], ["H", "F"]];
const WORDS = [["left", "right"], ["back", "front"], ["head", "feet"]];

function pick(names, direction) {
  let axis = 0;
  for (const k of [1, 2]) if (Math.abs(direction[k]) > Math.abs(direction[axis])) axis = k;
  return names[axis][direction[axis] >= 0 ? 0 : 1];
}

// The patient's side towards which a direction points.
export const letter = (direction) => pick(LETTERS, direction);
export const side = (direction) => pick(WORDS, direction);

export const opposite = (direction) => direction.map((value) => -value);

// Where a slice lies along its normal, as the console names it: "A 12.0" for 12 mm to the front.
export function slicePosition(geometry) {
  const down = geometry.row_direction;
  const right = geometry.col_direction;
  const normal = [right[1] * down[2] - right[2] * down[1], right[2] * down[0] - right[0] * down[2], right[0] * down[1] - right[1] * down[0]];
  let axis = 0;
  for (const k of [1, 2]) if (Math.abs(normal[k]) > Math.abs(normal[axis])) axis = k;
  const middle = patientFromPixel(geometry, [(geometry.shape[0] - 1) / 2, (geometry.shape[1] - 1) / 2]);
  return { axis, mm: middle[axis], letter: LETTERS[axis][middle[axis] >= 0 ? 0 : 1], plane: ["sagittal", "coronal", "axial"][axis] };
}

// How far a point lies in front of or behind a slice, mm along its normal.
export function distanceFromSlice(geometry, pointMm) {
  const [row, col] = pixelFromPatient(geometry, pointMm);
  const foot = patientFromPixel(geometry, [row, col]);
  return Math.hypot(...pointMm.map((value, k) => value - foot[k]));
}

const parts = (geometry, rowMm, colMm, part) => [[rowMm, geometry.row_direction], [colMm, geometry.col_direction]]
  .map(([value, direction]) => part(Math.abs(value), value >= 0 ? direction : opposite(direction))).join(", ");

// (row, col) mm in the slice -> "0.21 mm toward the head, 0.05 mm toward the left"
export const inWords = (geometry, rowMm, colMm, digits = 2) =>
  parts(geometry, rowMm, colMm, (mm, direction) => `${mm.toFixed(digits)} mm toward the ${side(direction)}`);

// the same in short: "H 0.21, L 0.05 mm"
export const inLetters = (geometry, rowMm, colMm, digits) =>
  `${parts(geometry, rowMm, colMm, (mm, direction) => `${letter(direction)} ${mm.toFixed(digits)}`)} mm`;

// Half-axes (mm) and direction (degrees, from growing columns to growing rows) of a covariance.
export function ellipse([[rr, rc], [, cc]], sigmas) {
  const middle = (rr + cc) / 2;
  const spread = Math.hypot((cc - rr) / 2, rc);
  return {
    long: sigmas * Math.sqrt(Math.max(middle + spread, 0)),
    short: sigmas * Math.sqrt(Math.max(middle - spread, 0)),
    turnDeg: (0.5 * Math.atan2(2 * rc, cc - rr) * 180) / Math.PI,
  };
}
