// The stages in their travel: x to the right, y upwards, mm; one map a stage.

import { byId, replace, s, whenChanged } from "./dom.js";
import { mm } from "./format.js";
import { TEXTS } from "./texts.js";

const { stages: words } = TEXTS;

const STAGES = [[words.top, "xt", "yt"], [words.bottom, "xb", "yb"]];

const [SIDE, PAD] = [80, 10];

function one([name, x, y], robot, plan) {
  const [x0, x1] = robot.travel_um[x];
  const [y0, y1] = robot.travel_um[y];
  const at = [robot.positions_um[x], robot.positions_um[y]];
  const scale = SIDE / Math.max(x1 - x0, y1 - y0);
  const [wide, high] = [(x1 - x0) * scale, (y1 - y0) * scale];
  // y grows upwards on the map, downwards in SVG
  const place = ([px, py]) => [(px - x0) * scale, (y1 - py) * scale];
  const [cx, cy] = place(at);
  const to = plan && place([plan.setpoints_um[x] ?? at[0], plan.setpoints_um[y] ?? at[1]]);
  const text = (dx, dy, anchor, words) => s("text", { x: dx, y: dy, "text-anchor": anchor }, words);
  return s("svg", { viewBox: `${-PAD} ${-PAD} ${wide + 2 * PAD} ${high + 2 * PAD}`, role: "img",
    "aria-label": `${name}: ${x} ${mm(at[0] / 1000, 3)} mm, ${y} ${mm(at[1] / 1000, 3)} mm` },
  s("rect", { width: wide, height: high, class: "thin c-quiet" }),
  s("path", { d: `M0 ${high / 2}H${wide}M${wide / 2} 0V${high}`, class: "thin c-line" }),
  to && s("line", { x1: cx, y1: cy, x2: to[0], y2: to[1], class: "thin c-plan" }),
  to && s("circle", { cx: to[0], cy: to[1], r: 2.6, class: "thin c-plan" }),
  s("circle", { cx, cy, r: 2, class: `thin c-fiducial${robot.position_certain ? " f-fiducial" : ""}` }),
  text(0, high + 7, "start", mm(x0 / 1000, 0)), text(wide, high + 7, "end", mm(x1 / 1000, 0)),
  text(wide / 2, high + 7, "middle", `${x} ${mm(at[0] / 1000, 3)} mm`),
  text(0, -3, "start", mm(y1 / 1000, 0)), text(wide / 2, -3, "middle", `${y} ${mm(at[1] / 1000, 3)} mm`));
}

export const drawStages = whenChanged(({ robot, plan }) => {
  const known = STAGES.filter(([, x, y]) => robot.travel_um[x] && robot.travel_um[y] && x in robot.positions_um && y in robot.positions_um);
  replace(byId("stages"), known.length ? known.map((stage) => one(stage, robot, plan)) : words.noLink);
});
