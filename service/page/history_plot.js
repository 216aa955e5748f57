// Error of each measurement to the target that was set then, ± 1 σ, on a logarithmic scale: the
// interesting errors go from 20 mm down to 0.02 mm.

import { byId, h, replace, s, whenChanged } from "./dom.js";
import { mm } from "./format.js";
import { TEXTS } from "./texts.js";

const { history: words } = TEXTS;

const [WIDE, HIGH, LEFT, BOTTOM, TOP] = [640, 220, 46, 24, 10];
const MOST = 40;

export const drawHistory = whenChanged(({ measurements, toleranceMm, guide }) => {
  const shown = measurements.filter((m) => m.error_mm !== null && m.error_mm !== undefined).slice(-MOST);
  const box = byId("history");
  if (guide) return replace(box, h("p", { class: "quiet" }, words.guide));
  if (!shown.length) return replace(box, h("p", { class: "quiet" }, words.nothing));
  const low = Math.min(0.01, (toleranceMm ?? 1) / 4);
  const high = Math.max(1, ...shown.map((m) => 1.3 * (m.error_mm + m.sigma_mm)));
  const y = (value) => {
    const part = Math.log(Math.max(value, low) / low) / Math.log(high / low);
    return HIGH - BOTTOM - part * (HIGH - BOTTOM - TOP);
  };
  const x = (place) => LEFT + (shown.length === 1 ? 0.5 : place / (shown.length - 1)) * (WIDE - LEFT - 14) + 4;
  const ticks = [0.01, 0.1, 1, 10, 100].filter((tick) => tick >= low && tick <= high);
  const line = shown.map((m, k) => `${k ? "L" : "M"}${x(k)} ${y(m.error_mm)}`).join("");
  replace(box, s("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, role: "img",
    "aria-label": words.picture(mm(shown.at(-1).error_mm, 3), toleranceMm === null ? "" : mm(toleranceMm, 3)) },
  ticks.map((tick) => [
    s("line", { x1: LEFT, x2: WIDE, y1: y(tick), y2: y(tick), class: "thin c-line" }),
    s("text", { x: LEFT - 6, y: y(tick) + 4, "text-anchor": "end" }, String(tick)),
  ]).flat(),
  s("text", { x: 0, y: TOP + 4 }, words.unit),
  s("text", { x: 0, y: HIGH - 5 }, words.axis),
  toleranceMm === null ? null : s("line", { x1: LEFT, x2: WIDE, y1: y(toleranceMm), y2: y(toleranceMm), class: "thin c-target dash" }),
  toleranceMm === null ? null : s("text", { x: WIDE, y: y(toleranceMm) - 4, "text-anchor": "end" }, words.tolerance),
  s("path", { d: line, class: "thin c-fiducial" }),
  shown.map((m, k) => s("g", {},
    s("title", {}, words.point(mm(m.error_mm, 3), mm(m.sigma_mm, 3), m.n_frames, m.method)),
    s("line", { x1: x(k), x2: x(k), y1: y(m.error_mm + m.sigma_mm), y2: y(m.error_mm - m.sigma_mm), class: "thin c-fiducial" }),
    s("circle", { cx: x(k), cy: y(m.error_mm), r: 3.2, class: "f-fiducial" }))),
  shown.map((m, k) => (k % Math.ceil(shown.length / 10) ? null : s("text", { x: x(k), y: HIGH - 5, "text-anchor": "middle" }, String(m.measurement_id))))));
});
