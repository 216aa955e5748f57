// Intensity along the row and the column through the fiducial: is its edge burnt out, is it round?

import { h, replace, s, setHidden } from "./dom.js";
import { pixelFromPatient } from "./geometry.js";
import { TEXTS } from "./texts.js";

const [WIDE, HIGH, LEFT, BOTTOM] = [220, 96, 4, 12];
const REACH_RADII = 2.5;

// box: the element that shows it; pixels: {values, rows, cols}; found: the measurement
export function drawProfile(box, geometry, pixels, found) {
  setHidden(box, !geometry || !pixels || !found?.patient_mm);
  if (box.hidden) return;
  const [row, col] = pixelFromPatient(geometry, found.patient_mm);
  const [r, c] = [Math.round(row), Math.round(col)];
  const reachMm = REACH_RADII * (found.radius_mm ?? 4);
  const along = (place, count, betweenMm, centre, valueAt) => {
    const points = [];
    for (let k = Math.max(0, Math.ceil(place - reachMm / betweenMm)); k <= Math.min(count - 1, place + reachMm / betweenMm); k += 1) {
      points.push([(k - centre) * betweenMm, valueAt(k)]);
    }
    return points;
  };
  const byRow = along(c, pixels.cols, geometry.spacing_mm[1], col, (k) => pixels.values[r * pixels.cols + k]);
  const byCol = along(r, pixels.rows, geometry.spacing_mm[0], row, (k) => pixels.values[k * pixels.cols + c]);
  const top = Math.max(1e-9, ...byRow.map((p) => p[1]), ...byCol.map((p) => p[1]));
  const x = (mm) => LEFT + ((mm + reachMm) / (2 * reachMm)) * (WIDE - 2 * LEFT);
  const y = (value) => HIGH - BOTTOM - (value / top) * (HIGH - BOTTOM - 4);
  const path = (points, kind) => s("path", { d: points.map(([mm, value], k) => `${k ? "L" : "M"}${x(mm)} ${y(value)}`).join(""), class: `thin ${kind}` });
  const edges = [-1, 1].map((way) => s("line", { x1: x(way * (found.radius_mm ?? 4)), x2: x(way * (found.radius_mm ?? 4)), y1: 2, y2: HIGH - BOTTOM, class: "thin c-target dash" }));
  replace(box, h("span", {}, TEXTS.image.profileOf(r)),
    s("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img", "aria-label": TEXTS.image.profileOf(r) },
      s("line", { x1: LEFT, x2: WIDE - LEFT, y1: HIGH - BOTTOM, y2: HIGH - BOTTOM, class: "thin c-quiet" }), edges,
      path(byRow, "c-fiducial"), path(byCol, "c-fiducial dash"),
      [-1, 0, 1].map((k) => s("text", { x: x(0.8 * k * reachMm), y: HIGH - 2, "text-anchor": "middle", "font-size": 9 }, (0.8 * k * reachMm).toFixed(0)))));
}
