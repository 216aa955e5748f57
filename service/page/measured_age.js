// How old what is shown as measured is, and how long it is still good: a push is seen by no sensor.

import { byId, setText } from "./dom.js";
import { age } from "./format.js";
import { TEXTS } from "./texts.js";

let measured = null;

export function measuredAt(state) {
  const { measurement, ready_valid_s: goodS } = state;
  const known = measurement?.state === "done" && Number.isFinite(measurement.age_s);
  measured = known ? { bornMs: state.heard_ms - 1000 * measurement.age_s, goodS, lost: measurement.lost } : null;
  tell();
}

function tell() {
  if (!measured) return setText(byId("measured-age"), "");
  const seconds = (performance.now() - measured.bornMs) / 1000;
  const left = measured.lost ? "" : TEXTS.distance.goodFor(age(Math.max(0, measured.goodS - seconds)));
  setText(byId("measured-age"), TEXTS.distance.measured(age(seconds), left));
}

setInterval(tell, 1000);
