// The move that waits for CONFIRM MOVE: what is off by how much, and where the axes would go.

import { h, s } from "./dom.js";
import { mm, signedMm } from "./format.js";
import { inLetters, inWords } from "./geometry.js";
import { arrow } from "./overlay.js";
import { TEXTS } from "./texts.js";

const { plan: words } = TEXTS;

const inSlice = (slice, row, col, how = inWords) => (slice ? how(slice, row, col, 3) : `${words.row} ${signedMm(row)}, ${words.col} ${signedMm(col)} mm`);

// With four axes: the distance that is left, of each fiducial and of the tip, before the move.
function partsOf(plan, slice) {
  const rows = plan.parts.map((part) => h("tr", { "data-part": part.name },
    h("th", { scope: "row" }, words.parts[part.name] ?? part.name, h("br", {}), inSlice(slice, part.row_mm, part.col_mm, inLetters)),
    h("td", {}, h("b", {}, `${mm(Math.hypot(part.row_mm, part.col_mm), 3)} mm`), h("br", {}), `± ${mm(part.sigma_mm, 3)}`)));
  return h("table", { class: "plan-parts" }, h("caption", { class: "quiet" }, words.distance), h("tbody", {}, rows));
}

export function planTable(plan, { slice }) {
  const [row, col] = plan.displacement_mm;
  const reach = 1.25 * Math.max(Math.abs(row), Math.abs(col), 0.01);
  const axes = Object.entries(plan.setpoints_um).filter(([axis, um]) => um !== plan.from_um[axis]);
  const moves = h("div", { class: "plan-axes" }, axes.map(([axis, um]) => h("p", {},
    h("span", { class: "quiet" }, axis), h("span", { class: "num" }, `${mm(plan.from_um[axis] / 1000, 3)} → ${mm(um / 1000, 3)} mm`))));
  if (plan.parts?.length) return h("div", {}, partsOf(plan, slice), moves);
  return h("div", { class: "error-grid" },
    h("div", {}, h("p", { class: "quiet" }, inSlice(slice, row, col)), moves),
    s("svg", { viewBox: `${-reach} ${-reach} ${2 * reach} ${2 * reach}`, role: "img", "aria-label": words.picture },
      s("path", { d: `M${-reach} 0H${reach}M0 ${-reach}V${reach}`, class: "thin c-line" }),
      s("circle", { r: reach * 0.04, class: "thin c-fiducial" }),
      arrow(0, 0, col, row, reach * 0.12)));
}
