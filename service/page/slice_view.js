// One image with its overlay. The overlay's SVG is in mm of the image plane: x along growing
// columns, y along growing rows, (0, 0) at the centre of the reference slice's pixel (0, 0).

import { h, replace, s } from "./dom.js";
import { letter, opposite, patientFromPixel, pixelFromPatient } from "./geometry.js";
import { mm } from "./format.js";
import { TEXTS } from "./texts.js";

const MOST_ZOOM = 64;
// the brightest pixel of the fiducial is shown a little below white
const HEADROOM = 1.06;

export class SliceView {
  constructor(name, onChange) {
    this.onChange = onChange;
    this.canvas = h("canvas", {});
    this.second = h("canvas", { hidden: true });
    this.svg = s("svg", { preserveAspectRatio: "none", role: "img", "aria-label": TEXTS.image.overlay(name) });
    this.inner = h("div", { class: "grid-mm" }, this.canvas, this.second, this.svg);
    this.sides = ["top", "bottom", "left", "right"].map((where) => h("span", { class: `side ${where}`, "aria-hidden": "true" }));
    this.what = h("span", { class: "what" });
    this.scale = h("span", { class: "scale", "aria-hidden": "true" });
    this.empty = h("div", { class: "empty" }, TEXTS.image.noSlice);
    this.root = h("div", { class: "view", tabIndex: 0, role: "group", "aria-label": TEXTS.image.help(name) },
      this.inner, this.sides, this.what, this.scale, this.empty);
    this.zoom = 1;
    this.middle = null;
    this.listen();
    new ResizeObserver(() => this.place()).observe(this.root);
  }

  // geometry: of the image; pixels: {values, rows, cols}
  show(geometry, pixels, words) {
    const fresh = !this.geometry || this.geometry.shape.join() !== geometry.shape.join();
    this.geometry = geometry;
    this.pixels = pixels;
    this.extent = [geometry.shape[1] * geometry.spacing_mm[1], geometry.shape[0] * geometry.spacing_mm[0]];
    if (fresh) this.middle = [this.extent[0] / 2, this.extent[1] / 2];
    this.empty.hidden = true;
    this.what.textContent = words;
    const { row_direction: down, col_direction: right } = geometry;
    [opposite(down), down, opposite(right), right].forEach((direction, k) => { this.sides[k].textContent = letter(direction); });
    this.svg.setAttribute("viewBox", `${-geometry.spacing_mm[1] / 2} ${-geometry.spacing_mm[0] / 2} ${this.extent[0]} ${this.extent[1]}`);
    this.place();
  }

  clear(words) {
    this.geometry = this.pixels = null;
    this.empty.hidden = false;
    this.empty.textContent = words;
    this.canvas.width = this.canvas.height = 0;
    this.second.hidden = true;
    replace(this.svg);
    this.what.textContent = "";
    this.scale.replaceChildren();
    this.sides.forEach((side) => { side.textContent = ""; });
  }

  // window and level in the image's own units
  paint({ window, level }, invert = false) {
    if (this.pixels) paint(this.canvas, this.pixels, window, level, invert);
  }

  blend(pixels, { window, level }, share) {
    this.second.hidden = !pixels || share <= 0;
    if (this.second.hidden) return;
    paint(this.second, pixels, window, level);
    this.second.style.opacity = share;
  }

  overlay(children) {
    replace(this.svg, children);
  }

  place() {
    if (!this.geometry) return;
    const [wide, high] = [this.root.clientWidth, this.root.clientHeight];
    const fit = Math.min(wide / this.extent[0], high / this.extent[1]);
    this.pxPerMm = fit * this.zoom;
    const left = wide / 2 - this.middle[0] * this.pxPerMm;
    const top = high / 2 - this.middle[1] * this.pxPerMm;
    Object.assign(this.inner.style, {
      left: `${left}px`, top: `${top}px`,
      width: `${this.extent[0] * this.pxPerMm}px`, height: `${this.extent[1] * this.pxPerMm}px`,
    });
    this.corner = [left, top];
    const long = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100].filter((l) => l * this.pxPerMm < 0.25 * wide).at(-1) ?? 0.1;
    const rule = h("i", {});
    rule.style.width = `${long * this.pxPerMm}px`;
    replace(this.scale, `${long} mm`, rule);
    this.onChange?.zoomed(this);
  }

  zoomBy(factor, at) {
    if (!this.geometry) return;
    const before = this.zoom;
    this.zoom = Math.min(MOST_ZOOM, Math.max(1, this.zoom * factor));
    if (at && this.zoom !== before) {
      const gain = 1 - before / this.zoom;
      this.middle = this.middle.map((value, k) => value + (at[k] - value) * gain);
    }
    if (this.zoom === 1) this.middle = [this.extent[0] / 2, this.extent[1] / 2];
    this.place();
  }

  fit() {
    this.zoom = 1;
    if (this.extent) this.middle = [this.extent[0] / 2, this.extent[1] / 2];
    this.place();
  }

  lookAt(rowMm, colMm, zoom) {
    this.zoom = zoom;
    this.middle = [colMm + this.geometry.spacing_mm[1] / 2, rowMm + this.geometry.spacing_mm[0] / 2];
    this.place();
  }

  // Where the pointer is: mm from the image's upper left corner (not the first pixel's centre)
  cornerMm(event) {
    const box = this.root.getBoundingClientRect();
    return [(event.clientX - box.left - this.corner[0]) / this.pxPerMm, (event.clientY - box.top - this.corner[1]) / this.pxPerMm];
  }

  pixelAt(event) {
    const [x, y] = this.cornerMm(event);
    return [y / this.geometry.spacing_mm[0] - 0.5, x / this.geometry.spacing_mm[1] - 0.5];
  }

  describe([row, col]) {
    const { shape } = this.geometry;
    if (row < -0.5 || col < -0.5 || row > shape[0] - 0.5 || col > shape[1] - 0.5) return null;
    const value = this.pixels.values[Math.round(row) * this.pixels.cols + Math.round(col)];
    const [x, y, z] = patientFromPixel(this.geometry, [row, col]);
    return { row, col, value, patient_mm: [x, y, z], words: `x ${mm(x)}  y ${mm(y)}  z ${mm(z)} mm` };
  }

  listen() {
    const root = this.root;
    root.addEventListener("wheel", (event) => {
      if (!this.geometry) return;
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 400), this.cornerMm(event));
    }, { passive: false });
    root.addEventListener("pointerdown", (event) => this.press(event));
    root.addEventListener("pointermove", (event) => this.drag(event));
    root.addEventListener("pointerup", (event) => this.release(event));
    root.addEventListener("pointerleave", () => this.onChange?.pointed(this, null));
    root.addEventListener("dblclick", () => this.fit());
    root.addEventListener("contextmenu", (event) => event.preventDefault());
    root.addEventListener("keydown", (event) => this.key(event));
  }

  press(event) {
    if (!this.geometry) return;
    this.root.setPointerCapture(event.pointerId);
    this.from = { x: event.clientX, y: event.clientY, middle: [...this.middle], windows: event.button === 2 || event.shiftKey, moved: false };
  }

  drag(event) {
    if (!this.geometry) return;
    if (this.from) {
      const [dx, dy] = [event.clientX - this.from.x, event.clientY - this.from.y];
      if (Math.hypot(dx, dy) > 4) this.from.moved = true;
      if (this.from.windows) this.onChange?.windowed(this, event.movementX, event.movementY);
      else if (this.from.moved && this.zoom > 1) {
        this.middle = [this.from.middle[0] - dx / this.pxPerMm, this.from.middle[1] - dy / this.pxPerMm];
        this.place();
      }
    }
    this.onChange?.pointed(this, this.describe(this.pixelAt(event)));
  }

  release(event) {
    const from = this.from;
    this.from = null;
    if (from && !from.moved && !from.windows) {
      const at = this.describe(this.pixelAt(event));
      if (at) this.onChange?.clicked(this, at);
    }
  }

  key(event) {
    const step = 30 / (this.pxPerMm || 1);
    const ways = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] };
    if (this.onChange?.nudged(event)) return event.preventDefault();
    if (event.key === "+" || event.key === "=") this.zoomBy(1.5);
    else if (event.key === "-") this.zoomBy(1 / 1.5);
    else if (event.key === "0") this.fit();
    else if (ways[event.key] && this.geometry) {
      this.middle = this.middle.map((value, k) => value + ways[event.key][k]);
      this.place();
    } else return;
    event.preventDefault();
  }
}

function paint(canvas, { values, rows, cols }, window, level, invert = false) {
  canvas.width = cols;
  canvas.height = rows;
  const context = canvas.getContext("2d");
  const image = context.createImageData(cols, rows);
  const low = level - window / 2;
  const gain = 255 / Math.max(window, 1e-9);
  for (let k = 0, at = 0; k < values.length; k += 1, at += 4) {
    let grey = (values[k] - low) * gain;
    grey = grey < 0 ? 0 : grey > 255 ? 255 : grey;
    if (invert) grey = 255 - grey;
    image.data[at] = image.data[at + 1] = image.data[at + 2] = grey;
    image.data[at + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

// The window in which all but the darkest and brightest pixels differ, and the whole fiducial does.
export function levelsOf({ geometry, pixels }, found) {
  const sorted = Float32Array.from(pixels.values).sort();
  const at = (part) => sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))];
  const low = at(0.01);
  const high = Math.max(at(0.998), HEADROOM * brightest(geometry, pixels, found));
  return { window: Math.max(high - low, 1e-6), level: (high + low) / 2 };
}

function brightest(geometry, { values, rows, cols }, found) {
  if (!found?.patient_mm) return 0;
  const [row, col] = pixelFromPatient(geometry, found.patient_mm);
  const reach = (found.radius_mm ?? 4) / Math.min(...geometry.spacing_mm);
  let most = 0;
  for (let r = Math.max(0, Math.round(row - reach)); r <= Math.min(rows - 1, row + reach); r += 1) {
    for (let c = Math.max(0, Math.round(col - reach)); c <= Math.min(cols - 1, col + reach); c += 1) most = Math.max(most, values[r * cols + c]);
  }
  return most;
}
