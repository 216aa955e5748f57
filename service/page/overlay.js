// What is drawn over an image, in mm of its plane.

import { s } from "./dom.js";
import { ellipse, pixelFromPatient } from "./geometry.js";
import { reachable, reachOutline } from "./reach.js";

const FIDUCIAL_MM = 4;
const SIGMAS = 3;

export function arrow(x0, y0, x1, y1, head) {
  const long = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [ux, uy] = [(x1 - x0) / long, (y1 - y0) / long];
  const barb = (turn) => `${x1 - head * (ux - turn * uy * 0.5)} ${y1 - head * (uy + turn * ux * 0.5)}`;
  return s("path", { d: `M${x0} ${y0}L${x1} ${y1}M${barb(1)}L${x1} ${y1}L${barb(-1)}`, class: "thin c-plan" });
}

export function cross(x, y, size, kind) {
  return s("path", { d: `M${x - size} ${y}h${2 * size}M${x} ${y - size}v${2 * size}`, class: `thin ${kind}` });
}

// A ring with four ticks: it can be seen from afar and leaves the point itself free.
function mark([x, y], kind, radiusMm) {
  const [near, far] = [2.2, 4.5];
  return [
    s("circle", { cx: x, cy: y, r: radiusMm, class: `thin ${kind}` }),
    s("path", { d: `M${x - far} ${y}H${x - near}M${x + near} ${y}H${x + far}M${x} ${y - far}V${y - near}M${x} ${y + near}V${y + far}`, class: `thin ${kind}` }),
  ];
}

// found: the measurement to draw the fiducial from (null: none belongs here); named: its circle
// carries the id by which it is found; current: it is the newest, a plan may start from it.
export function overlay(geometry, state, { found, named, current, picked }) {
  const at = (pointMm) => {
    const [row, col] = pixelFromPatient(geometry, pointMm);
    return [col * geometry.spacing_mm[1], row * geometry.spacing_mm[0]];
  };
  const { target_patient_mm: target, entry_patient_mm: entry, tolerance_mm: tolerance } = state;
  return [
    ...(found?.patient_mm ? fiducial(at, state, found, named, current) : []),
    ...guide(at, state, found),
    ...(target ? mark(at(target), "c-target", tolerance) : []),
    ...(entry ? mark(at(entry), "c-entry", 0.8) : []),
    ...(entry && target ? [line(at(entry), at(target), "c-entry dash")] : []),
    ...(picked ? [...reach(at, state), ...mark(at(picked), "c-plan dash", 1)] : []),
  ];
}

function reach(at, state) {
  const corners = reachable(state);
  return corners ? [reachOutline(at(state.measurement.patient_mm), corners)] : [];
}

const line = ([x1, y1], [x2, y2], kind) => s("line", { x1, y1, x2, y2, class: `thin ${kind}` });

function fiducial(at, state, found, named, current) {
  const [x, y] = at(found.patient_mm);
  const radius = found.radius_mm ?? FIDUCIAL_MM;
  const holds = found.slice_id === state.slice?.slice_id && !found.lost;
  const shape = ellipse(found.covariance_mm2 ?? [[0, 0], [0, 0]], SIGMAS);
  const parts = [
    s("circle", { id: named ? "fiducial" : null, cx: x, cy: y, r: radius, class: `thin c-fiducial${holds ? "" : " dash"}` }),
    cross(x, y, 0.7, "c-fiducial"),
    s("ellipse", { rx: shape.long, ry: shape.short, transform: `translate(${x} ${y}) rotate(${shape.turnDeg})`, class: "thin c-fiducial" }),
  ];
  const plan = state.question?.plan;
  if (!plan || !current) return parts;
  const [dRow, dCol] = plan.displacement_mm;
  return [...parts, arrow(x, y, x + dCol, y + dRow, Math.min(2, 0.4 * Math.hypot(dRow, dCol))),
    s("circle", { cx: x + dCol, cy: y + dRow, r: radius, class: "thin c-plan dash" })];
}

// Two fiducials: the other one as it was seen in its own slice, the guide's axis through both, and
// at READY the needle from the lower ball joint to its tip; all projected onto this slice.
function guide(at, { other_fiducial: other, arrival }, found) {
  const parts = [];
  if (other && found?.patient_mm) {
    const [[x, y], from] = [at(other.patient_mm), at(found.patient_mm)];
    parts.push(line(from, [x, y], "c-fiducial dash guide-axis"),
      s("circle", { cx: x, cy: y, r: other.radius_mm, class: "thin c-fiducial dash other-fiducial" }), cross(x, y, 0.7, "c-fiducial"));
  }
  if (arrival?.tip_mm && arrival.joint_mm) {
    const [[x, y], joint] = [at(arrival.tip_mm), at(arrival.joint_mm)];
    parts.push(line(joint, [x, y], "c-plan needle"), cross(x, y, 1.2, "c-plan"));
  }
  return parts;
}
