// Picking a target or an entry point: click, look at what it means, correct, then set.

import { order } from "./api.js";
import { act, showRefusal } from "./actions.js";
import { byId, h, replace, setHidden, setText } from "./dom.js";
import { mm } from "./format.js";
import { inWords, patientFromPixel, pixelFromPatient } from "./geometry.js";
import { TEXTS } from "./texts.js";

const { pick: words } = TEXTS;
const NUDGE_MM = 0.1;
const ASK_AFTER_MS = 250;

export class Picking {
  // view: the SliceView on which is picked; onMoved: the point is elsewhere now
  constructor(view, onMoved) {
    this.view = view;
    this.onMoved = onMoved;
    this.point = null;
    this.button = h("button", { type: "button", id: "pick", "aria-pressed": "false", onclick: () => this.toggle() }, words.start);
    this.panel = byId("pick-panel");
  }

  get isOn() {
    return this.button.getAttribute("aria-pressed") === "true";
  }

  draw(state, role) {
    this.state = state;
    this.button.disabled = role !== "operator" || !state.slice;
    if (this.isOn) this.say(this.point);
  }

  toggle() {
    if (this.isOn) return this.end();
    if (!this.view.geometry) return;
    this.button.setAttribute("aria-pressed", "true");
    document.body.classList.add("picking");
    setHidden(this.panel, false);
    const { shape } = this.view.geometry;
    const seen = this.state.target_patient_mm ?? this.state.measurement?.patient_mm;
    const start = seen ? this.onSlice(seen) : patientFromPixel(this.view.geometry, [shape[0] / 2, shape[1] / 2]);
    this.build();
    this.moveTo(start);
    this.view.root.focus({ preventScroll: true });
  }

  // The foot of a point on the slice that is shown: what is picked lies in that slice.
  onSlice(pointMm) {
    return patientFromPixel(this.view.geometry, pixelFromPatient(this.view.geometry, pointMm));
  }

  end() {
    this.button.setAttribute("aria-pressed", "false");
    document.body.classList.remove("picking");
    this.point = null;
    setHidden(this.panel, true);
    this.onMoved();
  }

  build() {
    this.inputs = words.axes.map((axis, k) => h("input", {
      type: "number", step: 0.01, "aria-label": words.field(axis), id: `pick-${axis}`,
      onchange: (event) => { if (Number.isFinite(event.target.valueAsNumber)) this.moveTo(this.point.map((value, j) => (j === k ? event.target.valueAsNumber : value))); },
    }));
    this.label = h("input", { id: "pick-label", maxLength: 80, placeholder: words.labelHint, autocomplete: "off" });
    this.inTissue ??= h("input", { type: "checkbox", id: "in-tissue" });
    this.facts = h("p", { class: "facts", role: "status" });
    const withdraw = this.state.target_patient_mm ? h("button", {
      type: "button", onclick: async () => { if (await act(() => order("POST", "api/v1/target/withdraw"))) this.end(); },
    }, words.withdraw) : null;
    replace(this.panel, h("h2", { id: "h-pick" }, words.heading), h("p", { class: "quiet" }, words.how),
      h("div", { class: "point" }, this.inputs.map((input, k) => h("label", {}, `${words.axes[k]}, ${words.unit}`, input))),
      h("div", { class: "fields more" }, h("label", { htmlFor: "pick-label" }, words.label), this.label),
      this.facts,
      h("p", { class: "row" },
        h("button", { type: "button", id: "set-target", class: "main", onclick: () => this.set("target") }, words.setTarget),
        h("button", { type: "button", id: "set-entry", onclick: () => this.set("entry") }, words.setEntry), withdraw,
        h("button", { type: "button", onclick: () => this.end() }, words.cancel)),
      h("p", { class: "row more" }, this.inTissue, h("label", { htmlFor: "in-tissue" }, words.inTissue)),
      h("p", { class: "quiet" }, words.inTissueWhy));
  }

  moveTo(pointMm) {
    this.point = pointMm;
    this.inputs.forEach((input, k) => { if (input !== document.activeElement) input.value = pointMm[k].toFixed(2); });
    this.say(pointMm);
    this.onMoved();
  }

  // What a point means: how far from the fiducial, and whether the axes could go there.
  say(pointMm) {
    if (!pointMm) return;
    const { measurement, slice, belief, robot } = this.state;
    const parts = [];
    if (measurement?.patient_mm && slice) {
      const from = pixelFromPatient(slice, measurement.patient_mm);
      const to = pixelFromPatient(slice, pointMm);
      const offset = to.map((value, k) => (value - from[k]) * slice.spacing_mm[k]);
      parts.push(words.distance(mm(Math.hypot(...offset), 2), inWords(slice, ...offset)));
      if (this.state.guide) this.askReach(pointMm);
      parts.push(this.state.guide ? this.toldReach(pointMm) : reach(offset, belief?.calibration?.per_axis, robot));
    }
    setText(this.facts, parts.filter(Boolean).join(" "));
  }

  // With four axes the line from entry to target decides: the service works it out.
  askReach(pointMm) {
    const asked = JSON.stringify([pointMm, this.state.entry_patient_mm, this.state.robot.positions_um, this.inTissue.checked]);
    if (asked === this.asked) return;
    this.asked = asked;
    clearTimeout(this.asking);
    this.asking = setTimeout(async () => {
      try {
        const { verdict, text } = await order("POST", "api/v1/target/reach", { patient_mm: pointMm, in_water: this.inTissue.checked });
        this.told = { of: String(pointMm), words: words.told[verdict](text) };
      } catch (error) {
        this.told = { of: String(pointMm), words: error.message };
      }
      if (this.isOn && this.asked === asked) this.say(this.point);
    }, ASK_AFTER_MS);
  }

  toldReach(pointMm) {
    return this.told?.of === String(pointMm) ? this.told.words : "";
  }

  async set(what) {
    const empty = this.inputs.find((input) => !Number.isFinite(input.valueAsNumber));
    if (empty) return showRefusal(words.empty(empty.getAttribute("aria-label")));
    const more = what === "target" ? { in_water: this.inTissue.checked, label: this.label.value.trim() } : {};
    if (await act(() => order("PUT", `api/v1/${what}`, { patient_mm: this.point, ...more }))) this.end();
  }

  clicked(pointMm) {
    if (this.isOn) this.moveTo(pointMm);
  }

  // true if the key moved the point
  nudge(event) {
    const geometry = this.view.geometry;
    if (!this.isOn || !geometry) return false;
    const { row_direction: down, col_direction: right } = geometry;
    const way = { ArrowLeft: [right, -1], ArrowRight: [right, 1], ArrowUp: [down, -1], ArrowDown: [down, 1] }[event.key];
    if (!way) return false;
    this.moveTo(this.point.map((value, k) => value + way[1] * NUDGE_MM * way[0][k]));
    return true;
  }
}

// Whether a displacement (row, col) mm is within the travel, by the calibration: two axes only.
function reach([row, col], perAxis, robot) {
  const axes = Object.keys(perAxis ?? {});
  if (axes.length !== 2) return words.reachUnknown;
  const [[a, c], [b, d]] = axes.map((axis) => perAxis[axis].column_mm);
  const det = a * d - b * c;
  if (Math.abs(det) < 1e-6) return words.reachUnknown;
  const moves = [(d * row - b * col) / det, (a * col - c * row) / det];
  for (const [k, axis] of axes.entries()) {
    const limits = robot.travel_um[axis];
    if (!limits || !(axis in robot.positions_um)) return words.reachUnknown;
    const to = robot.positions_um[axis] + 1000 * moves[k];
    if (!(to >= limits[0] && to <= limits[1])) return words.unreachable(axis, mm(to / 1000), mm(limits[0] / 1000, 0), mm(limits[1] / 1000, 0));
  }
  return words.reachable;
}
