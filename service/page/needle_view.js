// With four axes: the needle seen from two sides, depth down the page: entry point, target, both
// fiducials, the guide's axis through them and, at READY, the needle.

import { byId, h, replace, s, setHidden, whenChanged } from "./dom.js";
import { TEXTS } from "./texts.js";

const { needle: words } = TEXTS;
const DEPTH = 1; // of patient LPS: y is the depth of coronal slices
// what runs to the right: [patient axis, sign, letters at the left and right edge]
const SIDES = [[0, 1, ["R", "L"]], [2, -1, ["H", "F"]]];
const [PAD_MM, TEXT_MM] = [14, 5];

// The axis of the guide goes on to the depth of the target.
function beyond(upper, lower, target) {
  const along = lower.map((value, k) => value - upper[k]);
  const share = target && along[DEPTH] ? (target[DEPTH] - upper[DEPTH]) / along[DEPTH] : 1.5;
  return upper.map((value, k) => value + share * along[k]);
}

function drawing([axis, sign, letters], down, { entry, target, fiducials, arrival }, known) {
  const at = (pointMm) => [sign * pointMm[axis], down * pointMm[DEPTH]];
  const places = known.map(at);
  const low = [0, 1].map((k) => Math.min(...places.map((p) => p[k])) - PAD_MM);
  const high = [0, 1].map((k) => Math.max(...places.map((p) => p[k])) + PAD_MM);
  // as wide as it needs, but never a mere strip
  const spare = Math.max(0, 0.5 * (high[1] - low[1]) - (high[0] - low[0])) / 2;
  low[0] -= spare;
  high[0] += spare;
  const line = (from, to, kind) => s("line", { x1: at(from)[0], y1: at(from)[1], x2: at(to)[0], y2: at(to)[1], class: `thin ${kind}` });
  const text = (x, y, anchor, content) => s("text", { x, y, "text-anchor": anchor, "font-size": TEXT_MM }, content);
  const point = (pointMm, kind, name, way = 1) => {
    const [x, y] = at(pointMm);
    return [s("circle", { cx: x, cy: y, r: 1.6, class: `thin ${kind}` }), text(x + way * 3, y + 1.6, way > 0 ? "start" : "end", name)];
  };
  const [first, second] = fiducials;
  const [near, far] = down > 0 ? [words.front, words.back] : [words.back, words.front];
  const middle = (low[0] + high[0]) / 2;
  return s("svg", { viewBox: `${low[0]} ${low[1]} ${high[0] - low[0]} ${high[1] - low[1]}`, role: "img", "aria-label": `${words.picture} (${letters.join("–")})` },
    text(low[0] + 1, (low[1] + high[1]) / 2, "start", letters[0]), text(high[0] - 1, (low[1] + high[1]) / 2, "end", letters[1]),
    text(middle, low[1] + TEXT_MM, "middle", near), text(middle, high[1] - 1.5, "middle", far),
    entry && target ? line(entry, target, "c-entry dash") : null,
    first && second ? line(first.patient_mm, beyond(first.patient_mm, second.patient_mm, target), "c-fiducial dash") : null,
    arrival?.tip_mm ? line(arrival.joint_mm, arrival.tip_mm, "c-plan") : null,
    entry ? point(entry, "c-entry", words.entry) : null,
    target ? point(target, "c-target", words.target) : null,
    fiducials.map((one) => point(one.patient_mm, "c-fiducial", words[one.name] ?? one.name)),
    arrival?.tip_mm ? point(arrival.tip_mm, "c-plan", words.tip, -1) : null);
}

export const drawNeedle = whenChanged((seen) => {
  const box = byId("needle");
  if (!seen.guide) return setHidden(box, true);
  const { entry, target, fiducials, arrival } = seen;
  const known = [entry, target, ...fiducials.map((one) => one.patient_mm), arrival?.tip_mm, arrival?.joint_mm].filter(Boolean);
  const heading = h("h2", { id: "h-needle" }, words.heading);
  if (known.length < 2) return replace(box, heading, h("p", { class: "quiet" }, words.nothing));
  // the guide is above, the target below, whichever way the patient lies
  const [top, bottom] = [fiducials[0]?.patient_mm ?? entry, target ?? known.at(-1)];
  const down = top && bottom && top[DEPTH] > bottom[DEPTH] ? -1 : 1;
  replace(box, heading, h("div", { class: "sides" }, SIDES.map((side) => drawing(side, down, seen, known))));
});
