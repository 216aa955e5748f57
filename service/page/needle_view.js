// With four axes: the needle seen from the side, depth (patient front to back) across the page.
// Entry point, target, both fiducials, the guide's axis through them and, at READY, the needle.

import { byId, h, replace, s, setHidden, whenChanged } from "./dom.js";
import { TEXTS } from "./texts.js";

const { needle: words } = TEXTS;
const [DEPTH, ACROSS] = [1, 2]; // of patient LPS: y is depth of a coronal slice, z is up the page
const PAD_MM = 12;

// LPS mm -> (x, y) on the drawing: back to the right, head upwards
const at = (pointMm) => [pointMm[DEPTH], -pointMm[ACROSS]];

function point(pointMm, kind, name) {
  const [x, y] = at(pointMm);
  return [
    s("circle", { cx: x, cy: y, r: 2.2, class: `thin ${kind}` }),
    s("text", { x, y: y - 4, "text-anchor": "middle", "font-size": "5" }, name),
  ];
}

const line = (from, to, kind) => s("line", { x1: at(from)[0], y1: at(from)[1], x2: at(to)[0], y2: at(to)[1], class: `thin ${kind}` });

// The axis of the guide goes on to the depth of the target.
function beyond(upper, lower, target) {
  const along = lower.map((value, k) => value - upper[k]);
  const share = target && along[DEPTH] ? (target[DEPTH] - upper[DEPTH]) / along[DEPTH] : 1.5;
  return upper.map((value, k) => value + share * along[k]);
}

export const drawNeedle = whenChanged(({ guide, entry, target, fiducials, arrival }) => {
  const box = byId("needle");
  setHidden(box, !guide);
  if (!guide) return;
  const known = [entry, target, ...fiducials.map((one) => one.patient_mm), arrival?.tip_mm, arrival?.joint_mm].filter(Boolean);
  const heading = h("h2", { id: "h-needle" }, words.heading);
  if (known.length < 2) return replace(box, heading, h("p", { class: "quiet" }, words.nothing));
  const places = known.map(at);
  const low = [0, 1].map((k) => Math.min(...places.map((p) => p[k])) - PAD_MM);
  const high = [0, 1].map((k) => Math.max(...places.map((p) => p[k])) + PAD_MM);
  // the one nearer to the patient's front is the upper one where the robot lies on a prone patient
  const [first, second] = fiducials;
  const axis = first && second ? line(first.patient_mm, beyond(first.patient_mm, second.patient_mm, target), "c-fiducial dash") : null;
  replace(box, heading, s("svg", { viewBox: `${low[0]} ${low[1]} ${high[0] - low[0]} ${high[1] - low[1]}`, role: "img", "aria-label": words.picture },
    s("text", { x: low[0] + 1, y: high[1] - 2, "font-size": "5" }, words.front),
    s("text", { x: high[0] - 1, y: high[1] - 2, "font-size": "5", "text-anchor": "end" }, words.back),
    entry && target ? line(entry, target, "c-entry dash") : null, axis,
    arrival?.tip_mm ? line(arrival.joint_mm, arrival.tip_mm, "c-plan") : null,
    ...(entry ? point(entry, "c-entry", words.entry) : []),
    ...(target ? point(target, "c-target", words.target) : []),
    ...fiducials.flatMap((one) => point(one.patient_mm, "c-fiducial", words[one.name] ?? one.name)),
    ...(arrival?.tip_mm ? point(arrival.tip_mm, "c-plan", words.tip) : [])));
});
