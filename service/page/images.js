// The image area: the slice that is shown and the newest reconstruction, window and level, zoom.

import { getPixels, ofCase } from "./api.js";
import { h, replace, setText, whenChanged } from "./dom.js";
import { age, clock } from "./format.js";
import { distanceFromSlice, pixelFromPatient } from "./geometry.js";
import { overlay } from "./overlay.js";
import { Picking } from "./picking.js";
import { drawProfile } from "./profile.js";
import { SliceList } from "./slice_list.js";
import { levelsOf, SliceView } from "./slice_view.js";
import { TEXTS } from "./texts.js";

const { image: words } = TEXTS;
const LAYOUTS = ["slice", "both", "reconstruction", "blend", "residual"];
const NARROW_PX = 1100;
// a fiducial is drawn on slices that lie this near to it, mm
const SAME_SLICE_MM = 3;

export class Images {
  constructor(root) {
    this.root = root;
    const on = {
      zoomed: (view) => this.follow(view),
      pointed: (view, at) => this.point(at),
      clicked: (view, at) => this.picking.clicked(at.patient_mm),
      windowed: (view, dx, dy) => this.windowBy(dx, dy),
      nudged: (event) => this.picking.nudge(event),
    };
    this.slice = new SliceView(words.sliceNumber, on);
    this.sr = new SliceView(words.reconstruction, on);
    this.residual = new SliceView(words.residual, on);
    this.picking = new Picking(this.slice, () => this.overlays());
    this.chosen = null; // a slice of before that the operator wants to see; null: the newest
    this.build();
    this.loadSlice = whenChanged(({ id }) => this.fetchSlice(id));
    this.loadSr = whenChanged(({ id }) => this.fetchSr(id));
    this.loadResidual = whenChanged((id) => this.fetchResidual(id));
    this.drawOverlay = whenChanged(() => this.overlays());
    this.listSlices = whenChanged(() => this.list.refresh(this.shownId()).catch(() => { /* the stream says when the service is back */ }));
    this.setLayout(innerWidth < NARROW_PX ? "slice" : "both");
    setInterval(() => this.tickAge(), 500);
  }

  build() {
    const button = (text, run, more = {}) => h("button", { type: "button", onclick: run, ...more }, text);
    this.buttons = LAYOUTS.map((layout) => button(words.layouts[layout], () => this.setLayout(layout)));
    this.window = h("input", { type: "range", min: 0, max: 1000, value: 500, oninput: () => this.slid() });
    this.level = h("input", { type: "range", min: 0, max: 1000, value: 500, oninput: () => this.slid() });
    this.share = h("input", { type: "range", min: 0, max: 100, value: 50, oninput: () => this.repaint() });
    this.shareLabel = h("label", { hidden: true }, words.blend, " ", this.share);
    this.smooth = button(words.smooth, () => this.toggleSmooth(), { "aria-pressed": "false" });
    this.profile = button(words.profile, () => this.toggleProfile(), { "aria-pressed": "false", id: "profile" });
    this.newest = button(words.newest, () => this.choose(null), { hidden: true, id: "newest-slice" });
    this.camera = h("a", { hidden: true, id: "camera", target: "_blank", rel: "noopener" }, words.camera);
    const bar = h("div", { class: "bar" },
      h("span", { class: "group", role: "group", "aria-label": words.which }, this.buttons), this.newest, this.camera,
      h("label", {}, words.window, " ", this.window), h("label", {}, words.level, " ", this.level),
      button(words.auto, () => { this.manual = null; this.repaint(); }),
      this.shareLabel, this.smooth, this.profile, h("span", { class: "push" }),
      h("span", { class: "group", role: "group", "aria-label": words.zoom },
        button("−", () => this.zoomBy(1 / 1.5), { "aria-label": words.zoomOut }), button(words.whole, () => this.zoomBy(0)),
        button("+", () => this.zoomBy(1.5), { "aria-label": words.zoomIn }), button(words.fiducial, () => this.zoomToFiducial())),
      this.picking.button);
    this.inset = h("div", { class: "inset", hidden: true });
    this.slice.root.append(this.inset);
    const strip = h("nav", { id: "strip", "aria-label": TEXTS.strip.heading });
    this.cursor = h("span", { class: "cursor" }, " ");
    this.ageText = h("span", { id: "image-age" });
    this.source = h("span", {});
    replace(this.root, bar,
      h("div", { class: "stage" }, strip, h("div", { class: "views" }, this.slice.root, this.sr.root, this.residual.root, h("section", { id: "needle", class: "view", "aria-labelledby": "h-needle", hidden: true }))),
      h("div", { class: "read" }, this.ageText, this.source, this.cursor));
    this.list = new SliceList(strip, (row) => this.choose(row));
  }

  setLayout(layout) {
    this.layout = layout;
    this.buttons.forEach((button, k) => button.setAttribute("aria-pressed", String(LAYOUTS[k] === layout)));
    this.slice.root.hidden = layout === "reconstruction";
    this.placeViews();
    this.shareLabel.hidden = layout !== "blend";
    this.repaint();
  }

  // With two fiducials there is no reconstruction as a rule: beside the slice stands the needle then.
  showsNeedle() {
    return Boolean(this.state?.guide && !this.state.reconstruction && this.layout === "both");
  }

  placeViews() {
    this.sr.root.hidden = !["both", "reconstruction"].includes(this.layout) || this.showsNeedle();
    this.residual.root.hidden = this.layout !== "residual";
    if (this.layout === "residual" && this.state?.measurement?.state === "done") this.loadResidual(this.state.measurement.measurement_id);
    const needle = this.root.querySelector("#needle");
    if (needle) needle.hidden = !this.showsNeedle();
  }

  draw(state, role) {
    const before = this.state?.slice?.slice_id;
    this.state = state;
    this.placeViews();
    // a new slice is what matters: it is shown, unless somebody picks on an older one just now
    if (before && state.slice?.slice_id !== before && !this.picking.isOn) this.chosen = null;
    this.newest.hidden = !this.chosen;
    this.camera.hidden = !state.camera_preview_url;
    if (state.camera_preview_url) this.camera.href = state.camera_preview_url;
    this.picking.draw(state, role);
    if (state.slice) this.loadSlice({ id: this.shownId() });
    if (state.reconstruction) this.loadSr({ id: state.reconstruction.measurement_id });
    this.listSlices([state.last_slice_id, state.slices]);
    this.drawOverlay([state.slice, state.measurement, state.target_patient_mm, state.entry_patient_mm, state.error, state.question?.plan, state.tolerance_mm, state.other_fiducial, state.arrival, state.belief?.fiducials]);
    this.tickAge();
  }

  shownId() {
    return this.chosen?.slice_id ?? this.state?.slice?.slice_id;
  }

  // A slice of the list, or null for the newest one of the measurement.
  choose(row) {
    this.chosen = row && row.slice_id !== this.state.slice?.slice_id ? row : null;
    this.newest.hidden = !this.chosen;
    if (this.layout === "reconstruction") this.setLayout("slice");
    this.loadSlice({ id: this.shownId() });
  }

  async fetchSlice(id) {
    const geometry = this.chosen ? this.chosen.geometry : this.state.slice;
    this.list.shown(id);
    try {
      const pixels = await getPixels(ofCase(`api/v1/slices/${id}/pixels`));
      if (this.shownId() !== id) return;
      this.slice.show(geometry, pixels, this.chosen ? words.earlierSlice(id) : words.slice(id));
      this.slice.what.classList.toggle("earlier", Boolean(this.chosen));
      requestAnimationFrame(() => performance.mark("slice-shown", { detail: id }));
    } catch (error) {
      this.slice.clear(error.message);
    }
    this.repaint();
    this.overlays();
  }

  async fetchSr(id) {
    const geometry = this.state.reconstruction;
    try {
      this.sr.show(geometry, await getPixels(ofCase(`api/v1/measurements/${id}/pixels`)), words.ofMeasurement(geometry.factor, id, false));
    } catch (error) {
      this.sr.clear(error.message);
    }
    this.repaint();
    this.overlays();
  }

  // What the fit leaves, in grey around nothing: white and black are four standard deviations away.
  async fetchResidual(id) {
    const { slice, measurement } = this.state;
    try {
      const pixels = await getPixels(ofCase(`api/v1/measurements/${id}/residual`));
      const left = pixels.values.filter((value) => value !== 0);
      const deviation = Math.sqrt(left.reduce((sum, value) => sum + value * value, 0) / Math.max(1, left.length));
      const first = !this.residual.geometry;
      this.residual.show(slice, pixels, words.residualOf(measurement.slice_id, measurement.chi2_per_dof?.toFixed(2), measurement.method));
      this.residual.paint({ window: 8 * deviation, level: 0 });
      if (first) this.zoomToFiducial();
    } catch (error) {
      this.residual.clear(error.message);
    }
  }

  // Window and level: automatic for each image, or one choice relative to the automatic one. The
  // automatic one spans the whole fiducial: its plateau and edge are not burnt out.
  levels(view) {
    const own = levelsOf(view, view === this.sr ? this.state?.reconstruction : this.state?.measurement);
    if (!this.manual) return own;
    return { window: own.window * this.manual.window, level: own.level + own.window * this.manual.level };
  }

  repaint() {
    this.window.value = 500 + 250 * Math.log2(this.manual?.window ?? 1);
    this.level.value = 500 + 500 * (this.manual?.level ?? 0);
    for (const view of [this.slice, this.sr]) if (view.pixels) view.paint(this.levels(view));
    const blended = this.layout === "blend" && this.sr.pixels ? this.sr.pixels : null;
    if (this.slice.pixels) this.slice.blend(blended, blended ? this.levels(this.sr) : {}, this.share.value / 100);
    if (!this.sr.pixels) this.sr.clear(words.noReconstruction);
    if (!this.residual.pixels) this.residual.clear(words.noResidual);
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
    const smooth = pressed(this.smooth);
    for (const view of [this.slice, this.sr]) view.root.classList.toggle("smooth", smooth);
  }

  toggleProfile() {
    pressed(this.profile);
    this.overlays();
  }

  zoomBy(factor) {
    for (const view of this.shown()) if (factor) view.zoomBy(factor); else view.fit();
  }

  shown() {
    return [this.slice, this.sr, this.residual].filter((view) => !view.root.hidden);
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
    const other = view !== this.slice ? this.slice : this.layout === "residual" ? this.residual : this.sr;
    if (!["both", "residual"].includes(this.layout) || this.chosen || !other.geometry || (other.zoom === view.zoom && String(other.middle) === String(view.middle))) return;
    other.zoom = view.zoom;
    other.middle = [...view.middle];
    other.place();
  }

  point(at) {
    setText(this.cursor, at ? words.cursor(at.words, at.row.toFixed(1), at.col.toFixed(1), at.value.toPrecision(4)) : " ");
  }

  tickAge() {
    const slice = this.chosen ?? this.state?.slice;
    if (!slice) return;
    setText(this.ageText, words.age(slice.slice_id, clock(slice.received_s), age(Date.now() / 1000 - slice.received_s)));
    setText(this.source, words.source(TEXTS.strip.kinds[slice.state] ?? slice.state, slice.time_source));
  }

  overlays() {
    if (!this.state) return;
    const { measurement, reconstruction } = this.state;
    const picked = this.picking.point;
    if (this.slice.geometry) {
      const near = measurement?.patient_mm && distanceFromSlice(this.slice.geometry, measurement.patient_mm) < SAME_SLICE_MM;
      this.slice.overlay(overlay(this.slice.geometry, this.state, { found: this.chosen && !near ? null : measurement, named: true, current: !this.chosen, picked }));
    }
    drawProfile(this.inset, this.profile.getAttribute("aria-pressed") === "true" ? this.slice.geometry : null, this.slice.pixels, measurement);
    if (!this.sr.geometry) return;
    // the robot may have moved since the reconstruction: show the fiducial where it was then
    const current = reconstruction.measurement_id === measurement?.measurement_id;
    const found = current ? measurement : { patient_mm: reconstruction.patient_mm, radius_mm: reconstruction.radius_mm };
    this.sr.overlay(overlay(this.sr.geometry, this.state, { found, current, picked }));
    this.sr.what.textContent = words.ofMeasurement(reconstruction.factor, reconstruction.measurement_id, !current);
    this.sr.what.classList.toggle("earlier", !current);
  }
}

function pressed(button) {
  const on = button.getAttribute("aria-pressed") !== "true";
  button.setAttribute("aria-pressed", String(on));
  return on;
}
