// What the system believes and why: calibration, goal, hold, σ and what it is made of.

import { order } from "./api.js";
import { act } from "./actions.js";
import { byId, h, replace, setText, whenChanged } from "./dom.js";
import { clock, mm, percent } from "./format.js";
import { TEXTS } from "./texts.js";

const { belief: words } = TEXTS;

const row = (name, ...value) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: "left" }, value));
const lines = (texts) => texts.map((text, k) => (k ? [h("br", {}), text] : text)).flat();

function calibrationRow(calibration) {
  if (!calibration) return row(words.calibration, words.notCalibrated);
  const axes = Object.entries(calibration.per_axis).map(([axis, one]) => words.axis(axis, one.scale.toFixed(4), one.angle_deg.toFixed(1), one.scale_sigma.toFixed(4)));
  return row(words.calibration, lines([words.when(clock(calibration.at_s)), ...axes]));
}

export const drawBelief = whenChanged((belief) => {
  const { goal, hold, fiducials } = belief;
  const rows = [
    calibrationRow(belief.calibration),
    row(words.strategy, goal.strategy),
    row(words.tolerance, words.goal(mm(goal.tolerance_mm, 3), percent(goal.confidence))),
    hold ? row(words.hold, words.holdOf(hold.hold_id, hold.place, hold.of)) : null,
    ...fiducials.map((one) => row(one.name ? TEXTS.plan.parts[one.name] : words.fiducial, words.sigmaOf(mm(one.sigma_row_mm, 4), mm(one.sigma_col_mm, 4)))),
    belief.made_of ? row(words.madeOf, belief.made_of) : null,
    belief.why ? row(words.why, belief.why) : null,
  ];
  replace(byId("belief"), h("table", {}, h("tbody", {}, rows.filter(Boolean))), belief.settings ? settingsForm(belief) : null);
});

function settingsForm({ goal, settings }) {
  const said = h("span", { role: "status", class: "quiet" });
  const number = (name, [low, high]) => h("input", { id: `set-${name}`, name, type: "number", step: "any", min: low, max: high, value: goal[name], required: true });
  const choice = h("select", { id: "set-strategy", name: "strategy" }, settings.strategies.map((one) => h("option", { value: one, selected: one === goal.strategy }, one)));
  const field = (name, text, input, note) => [h("label", { htmlFor: `set-${name}` }, text, note ? h("span", { class: "quiet" }, ` (${note})`) : null), input];
  const bounds = ([low, high]) => words.bounds(low, high);
  const form = h("form", {
    class: "fields more",
    onsubmit: async (event) => {
      event.preventDefault();
      const body = { strategy: choice.value, tolerance_mm: form.elements.tolerance_mm.valueAsNumber, confidence: form.elements.confidence.valueAsNumber, most_slices: form.elements.most_slices.valueAsNumber };
      if (await act(() => order("PUT", "api/v1/settings", body))) setText(said, words.applied);
    },
  },
  field("strategy", words.strategy, choice),
  field("tolerance_mm", `${words.tolerance}, mm`, number("tolerance_mm", settings.tolerance_mm), bounds(settings.tolerance_mm)),
  field("confidence", words.confidence, number("confidence", settings.confidence), bounds(settings.confidence)),
  field("most_slices", words.mostSlices, number("most_slices", settings.most_slices), bounds(settings.most_slices)),
  h("span", {}), h("p", { class: "row" }, h("button", { class: "small" }, words.apply), said));
  return h("details", { id: "settings" }, h("summary", {}, words.settings), form);
}
