// The image area: newest slice and newest reconstruction, their overlay, window and level, picking.

import { getPixels, order } from "./api.js";
import { h, replace, s, setText, whenChanged } from "./dom.js";
import { ellipse, patientFromPixel, pixelFromPatient } from "./geometry.js";
import { act, arrow } from "./actions.js";
import { natural, SliceView } from "./slice_view.js";
import { age, clock } from "./format.js";

const LAYOUTS = [["slice", "Slice"], ["both", "Both"], ["reconstruction", "Reconstruction"], ["blend", "Blended"]];
const NUDGE_MM = 0.1;

export class Images {
  constructor(root) {
    this.root = root;
    const on = {
      zoomed: (view) => this.follow(view),
      pointed: (view, at) => this.point(view, at),
      clicked: (view, at) => this.pickAt(at.patient_mm),
      windowed: (view, dx, dy) => this.windowBy(dx, dy),
      nudged: (event) => this.nudge(event),
    };
    this.slice = new SliceView("Slice", on);
    this.sr = new SliceView("Reconstruction", on);
    this.layout = "both";
    this.picked = null;
    this.build();
    this.loadSlice = whenChanged((slice) => this.fetchSlice(slice));
    this.loadSr = whenChanged((reconstruction) => this.fetchSr(reconstruction));
    this.drawOverlay = whenChanged(() => this.overlays());
    setInterval(() => this.tickAge(), 500);
  }

  build() {
    this.buttons = LAYOUTS.map(([layout, words]) => h("button", { type: "button", "aria-pressed": String(layout === this.layout), onclick: () => this.setLayout(layout) }, words));
    this.window = h("input", { type: "range", min: 0, max: 1000, value: 500 , oninput: () => this.slid() });
    this.level = h("input", { type: "range", min: 0, max: 1000, value: 500, oninput: () => this.slid() });
    this.share = h("input", { type: "range", min: 0, max: 100, value: 50, oninput: () => this.repaint() });
    this.shareLabel = h("label", { hidden: true }, "Blend ", this.share);
    this.smooth = h("button", { type: "button", "aria-pressed": "false", class: "wide-only", onclick: () => this.toggleSmooth() }, "Smooth");
    this.picking = h("button", { type: "button", id: "pick", "aria-pressed": "false", onclick: () => this.togglePick() }, "Pick target");
    this.bar = h("div", { class: "bar" },
      h("span", { class: "group", role: "group", "aria-label": "Which image" }, this.buttons),
      h("label", {}, "Window ", this.window), h("label", {}, "Level ", this.level),
      h("button", { type: "button", onclick: () => { this.manual = null; this.repaint(); } }, "Auto"),
      this.shareLabel, this.smooth, h("span", { class: "push" }),
      h("span", { class: "group", role: "group", "aria-label": "Zoom" },
        h("button", { type: "button", "aria-label": "Zoom out", onclick: () => this.zoomBy(1 / 1.5) }, "−"),
        h("button", { type: "button", onclick: () => this.zoomBy(0) }, "Whole"),
        h("button", { type: "button", "aria-label": "Zoom in", onclick: () => this.zoomBy(1.5) }, "+"),
        h("button", { type: "button", onclick: () => this.zoomToFiducial() }, "Fiducial")),
      this.picking);
    this.views = h("div", { class: "views" }, this.slice.root, this.sr.root);
    this.cursor = h("span", { class: "cursor" }, " ");
    this.ageText = h("span", { id: "image-age" });
    this.source = h("span", {});
    this.pickBar = h("div", { class: "pick", hidden: true });
    replace(this.root, this.bar, this.views, this.pickBar,
      h("div", { class: "read" }, this.ageText, this.source, this.cursor));
  }

  setLayout(layout) {
    this.layout = layout;
    this.buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(LAYOUTS[k][0] === layout)));
    this.slice.root.hidden = layout === "reconstruction";
    this.sr.root.hidden = layout === "slice" || layout === "blend";
    this.shareLabel.hidden = layout !== "blend";
    this.repaint();
  }

  draw(state, role) {
    this.state = state;
    this.picking.disabled = role !== "operator" || !state.slice;
    if (state.slice) this.loadSlice({ id: state.slice.slice_id });
    const measured = state.measurement;
    if (state.reconstruction) this.loadSr({ id: state.reconstruction.measurement_id });
    this.drawOverlay([state.slice, measured, state.target_patient_mm, state.entry_patient_mm, state.error, state.question?.plan, state.tolerance_mm, this.picked, state.other_fiducial, state.arrival]);
    this.tickAge();
  }

  async fetchSlice({ id }) {
    const geometry = this.state.slice;
    try {
      const pixels = await getPixels(`api/v1/slices/${id}/pixels`);
      if (this.state.slice.slice_id !== id) return;
      this.slice.show(geometry, pixels, `Slice ${id}`);
      this.shownSliceId = id;
      requestAnimationFrame(() => performance.mark("slice-shown", { detail: id }));
    } catch (error) {
      this.slice.clear(error.message);
    }
    this.repaint();
    this.overlays();
  }

  async fetchSr({ id }) {
    const geometry = this.state.reconstruction;
    try {
      this.sr.show(geometry, await getPixels(`api/v1/measurements/${id}/pixels`), `×${geometry.factor}, measurement ${id}`);
    } catch (error) {
      this.sr.clear(error.message);
    }
    this.repaint();
    this.overlays();
  }

  // Window and level: automatic for each image, or one choice relative to the automatic one.

  levels(view) {
    const own = natural(view.pixels);
    if (!this.manual) return own;
    return { window: own.window * this.manual.window, level: own.level + own.window * this.manual.level };
  }

  repaint() {
    this.window.value = 500 + 250 * Math.log2(this.manual?.window ?? 1);
    this.level.value = 500 + 500 * (this.manual?.level ?? 0);
    for (const view of [this.slice, this.sr]) if (view.pixels) view.paint(this.levels(view));
    const blended = this.layout === "blend" && this.sr.pixels ? this.sr.pixels : null;
    if (this.slice.pixels) this.slice.blend(blended, blended ? this.levels(this.sr) : {}, this.share.value / 100);
    if (!this.sr.pixels) this.sr.clear("No reconstruction yet: it needs frames at several commanded shifts.");
  }

  slid() {
    this.manual = { window: 2 ** ((this.window.value - 500) / 250), level: (this.level.value - 500) / 500 };
    this.repaint();
  }

  windowBy(dx, dy) {
    const now = this.manual ?? { window: 1, level: 0 };
    this.manual = { window: Math.min(4, Math.max(0.05, now.window * Math.exp(dx / 200))), level: Math.min(1, Math.max(-1, now.level - dy / 400)) };
    this.repaint();
  }

  toggleSmooth() {
    const smooth = this.smooth.getAttribute("aria-pressed") !== "true";
    this.smooth.setAttribute("aria-pressed", String(smooth));
    for (const view of [this.slice, this.sr]) view.root.classList.toggle("smooth", smooth);
  }

  zoomBy(factor) {
    for (const view of this.shown()) if (factor) view.zoomBy(factor); else view.fit();
  }

  shown() {
    return [this.slice, this.sr].filter((view) => !view.root.hidden);
  }

  zoomToFiducial() {
    const at = this.state?.measurement?.patient_mm;
    for (const view of this.shown()) {
      if (!view.geometry || !at) continue;
      const [row, col] = pixelFromPatient(view.geometry, at);
      view.lookAt(row * view.geometry.spacing_mm[0], col * view.geometry.spacing_mm[1], 7);
    }
  }

  // Side by side, both views look at the same place.
  follow(view) {
    const other = view === this.slice ? this.sr : this.slice;
    if (this.layout !== "both" || !other.geometry || (other.zoom === view.zoom && String(other.middle) === String(view.middle))) return;
    other.zoom = view.zoom;
    other.middle = [...view.middle];
    other.place();
  }

  point(view, at) {
    setText(this.cursor, at ? `${at.words}  ·  row ${at.row.toFixed(1)}  column ${at.col.toFixed(1)}  ·  value ${at.value.toPrecision(4)}` : " ");
  }

  tickAge() {
    const slice = this.state?.slice;
    if (!slice) return;
    setText(this.ageText, `Slice ${slice.slice_id}: received ${clock(slice.received_s)}, ${age(Date.now() / 1000 - slice.received_s)} old`);
    setText(this.source, `${slice.state}${slice.time_source ? ` · time from ${slice.time_source}` : ""}`);
  }

  // The overlay

  overlays() {
    if (!this.state) return;
    if (this.slice.geometry) this.slice.overlay(this.overlay(this.slice.geometry, this.state.measurement));
    if (!this.sr.geometry) return;
    // the robot may have moved since the reconstruction: show the fiducial where it was then
    const current = this.state.reconstruction.measurement_id === this.state.measurement?.measurement_id;
    const shown = this.state.reconstruction;
    this.sr.overlay(this.overlay(this.sr.geometry, current ? this.state.measurement : { patient_mm: shown.patient_mm, radius_mm: shown.radius_mm }));
    this.sr.what.textContent = `×${shown.factor}, measurement ${shown.measurement_id}${current ? "" : " (earlier)"}`;
    this.sr.what.classList.toggle("earlier", !current);
  }

  overlay(geometry, found) {
    const { target_patient_mm: target, entry_patient_mm: entry, question, tolerance_mm: tolerance } = this.state;
    const at = (pointMm) => {
      const [row, col] = pixelFromPatient(geometry, pointMm);
      return [col * geometry.spacing_mm[1], row * geometry.spacing_mm[0]];
    };
    const parts = [];
    if (found?.patient_mm) {
      const [x, y] = at(found.patient_mm);
      const current = found.slice_id === this.state.slice?.slice_id;
      const newest = found === this.state.measurement;
      const shape = ellipse(found.covariance_mm2 ?? [[0, 0], [0, 0]], 3);
      parts.push(s("circle", { id: geometry.factor ? null : "fiducial", cx: x, cy: y, r: found.radius_mm ?? 4, class: `thin c-fiducial${current ? "" : " dash"}` }),
        cross(x, y, 0.7, "c-fiducial"),
        s("ellipse", { rx: shape.long, ry: shape.short, transform: `translate(${x} ${y}) rotate(${shape.turnDeg})`, class: "thin c-fiducial" }));
      const plan = question?.plan;
      if (plan && newest) {
        const [dRow, dCol] = plan.displacement_mm;
        parts.push(arrow(x, y, x + dCol, y + dRow, Math.min(2, 0.4 * Math.hypot(dRow, dCol))),
          s("circle", { cx: x + dCol, cy: y + dRow, r: found.radius_mm ?? 4, class: "thin c-plan dash" }));
      }
    }
    parts.push(...this.guide(at, found));
    if (target) parts.push(...mark(at(target), "c-target", tolerance));
    if (entry) {
      parts.push(...mark(at(entry), "c-entry", 0.8));
      if (target) parts.push(s("line", { x1: at(entry)[0], y1: at(entry)[1], x2: at(target)[0], y2: at(target)[1], class: "thin c-entry dash" }));
    }
    if (this.picked) parts.push(...mark(at(this.picked), "c-plan dash", 1));
    return parts;
  }

  // Two fiducials: the other one as it was seen in its own slice, the guide's axis through both, and
  // at READY the needle from the lower ball joint to its tip; all projected onto this slice.
  guide(at, found) {
    const { other_fiducial: other, arrival } = this.state;
    const parts = [];
    if (other && found?.patient_mm) {
      const [[x, y], [x0, y0]] = [at(other.patient_mm), at(found.patient_mm)];
      parts.push(s("line", { x1: x0, y1: y0, x2: x, y2: y, class: "thin c-fiducial dash guide-axis" }),
        s("circle", { cx: x, cy: y, r: other.radius_mm, class: "thin c-fiducial dash other-fiducial" }), cross(x, y, 0.7, "c-fiducial"));
    }
    if (arrival?.tip_mm && arrival.joint_mm) {
      const [[x, y], [x0, y0]] = [at(arrival.tip_mm), at(arrival.joint_mm)];
      parts.push(s("line", { x1: x0, y1: y0, x2: x, y2: y, class: "thin c-plan needle" }), cross(x, y, 1.2, "c-plan"));
    }
    return parts;
  }

  // Picking: click, look, correct with the arrow keys, then set.

  togglePick() {
    const on = this.picking.getAttribute("aria-pressed") !== "true";
    this.picking.setAttribute("aria-pressed", String(on));
    this.picked = null;
    if (on && this.slice.geometry) {
      const [rows, cols] = this.slice.geometry.shape;
      this.pickAt(this.state.target_patient_mm ?? this.state.measurement?.patient_mm ?? patientFromPixel(this.slice.geometry, [rows / 2, cols / 2]));
      this.slice.root.focus();
    } else this.endPick();
  }

  endPick() {
    this.picking.setAttribute("aria-pressed", "false");
    this.picked = null;
    this.pickBar.hidden = true;
    this.overlays();
  }

  pickAt(pointMm) {
    if (this.picking.getAttribute("aria-pressed") !== "true") return;
    this.picked = pointMm;
    this.pickBar.hidden = false;
    const number = (k, name) => h("label", {}, `${name} `, h("input", {
      type: "number", step: 0.01, value: pointMm[k].toFixed(2), "aria-label": `${name}, patient mm`,
      onchange: (event) => { this.picked = this.picked.map((value, j) => (j === k && Number.isFinite(event.target.valueAsNumber) ? event.target.valueAsNumber : value)); this.overlays(); },
    }));
    this.inTissue ??= h("input", { type: "checkbox", id: "in-tissue" });
    const withdraw = this.state.target_patient_mm ? h("button", {
      type: "button", onclick: () => act(async () => { await order("POST", "api/v1/target/withdraw"); this.endPick(); }),
    }, "Withdraw the target") : null;
    replace(this.pickBar, h("span", {}, "Target, patient mm (LPS); arrow keys move it by 0.1 mm: "),
      number(0, "x"), number(1, "y"), number(2, "z"),
      h("label", { title: "The oil of the fiducial and the water of tissue do not appear at the same place: allow for it." }, this.inTissue, " lies in tissue"),
      h("button", { type: "button", id: "set-target", onclick: () => act(() => this.setTarget("target")) }, "Set target"),
      h("button", { type: "button", id: "set-entry", onclick: () => act(() => this.setTarget("entry")) }, "Set entry point"),
      withdraw,
      h("button", { type: "button", onclick: () => this.endPick() }, "Leave"));
    this.overlays();
  }

  async setTarget(what) {
    const more = what === "target" ? { in_water: this.inTissue.checked } : {};
    await order("PUT", `api/v1/${what}`, { patient_mm: this.picked, ...more });
    this.endPick();
  }

  nudge(event) {
    if (!this.picked || !this.slice.geometry) return false;
    const { row_direction: down, col_direction: right } = this.slice.geometry;
    const ways = { ArrowLeft: [right, -1], ArrowRight: [right, 1], ArrowUp: [down, -1], ArrowDown: [down, 1] };
    const way = ways[event.key];
    if (!way) return false;
    this.pickAt(this.picked.map((value, k) => value + way[1] * NUDGE_MM * way[0][k]));
    return true;
  }
}

function cross(x, y, size, kind) {
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

