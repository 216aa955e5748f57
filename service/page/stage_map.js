// The stages in their travel: x to the right, y upwards, mm; one map a stage.

import { byId, replace, s, whenChanged } from "./dom.js";
import { mm } from "./words.js";

const STAGES = [["top stage", "xt", "yt"], ["bottom stage", "xb", "yb"]];

function one([name, x, y], robot, plan) {
  const [x0, x1] = robot.travel_um[x];
  const [y0, y1] = robot.travel_um[y];
  const at = [robot.positions_um[x], robot.positions_um[y]];
  const size = Math.max(x1 - x0, y1 - y0);
  const pad = 0.13 * size;
  const to = plan && [plan.setpoints_um[x] ?? at[0], plan.setpoints_um[y] ?? at[1]];
  // y grows upwards on the map, downwards in SVG
  const text = (dx, dy, anchor, words) => s("text", { x: dx, y: dy, "text-anchor": anchor, "font-size": size * 0.055, class: "map" }, words);
  return s("svg", { viewBox: `${x0 - pad} ${-y1 - pad} ${x1 - x0 + 2 * pad} ${y1 - y0 + 2 * pad}`, role: "img",
    "aria-label": `${name}: ${x} ${mm(at[0] / 1000, 3)} mm, ${y} ${mm(at[1] / 1000, 3)} mm` },
  s("rect", { x: x0, y: -y1, width: x1 - x0, height: y1 - y0, class: "thin", stroke: "var(--quiet)" }),
  s("path", { d: `M${x0} ${-(y0 + y1) / 2}H${x1}M${(x0 + x1) / 2} ${-y1}V${-y0}`, class: "thin", stroke: "var(--line)" }),
  to && s("line", { x1: at[0], y1: -at[1], x2: to[0], y2: -to[1], class: "thin c-plan" }),
  to && s("circle", { cx: to[0], cy: -to[1], r: size * 0.025, class: "thin c-plan" }),
  s("circle", { cx: at[0], cy: -at[1], r: size * 0.022, fill: robot.position_certain ? "var(--fiducial)" : "none", class: "thin c-fiducial" }),
  text(x0, -y0 + pad * 0.75, "start", `${mm(x0 / 1000, 0)}`), text(x1, -y0 + pad * 0.75, "end", `${mm(x1 / 1000, 0)} mm`),
  text((x0 + x1) / 2, -y0 + pad * 0.75, "middle", `${x} ${mm(at[0] / 1000, 3)}`),
  text((x0 + x1) / 2, -y1 - pad * 0.3, "middle", `${y} ${mm(at[1] / 1000, 3)}`));
}

export const drawStages = whenChanged(({ robot, plan }) => {
  const known = STAGES.filter(([, x, y]) => robot.travel_um[x] && robot.travel_um[y] && x in robot.positions_um && y in robot.positions_um);
  replace(byId("stages"), known.length ? known.map((stage) => one(stage, robot, plan)) : "No link to the robot yet.");
});
