// The case's slices with thumbnails, newest first, as many as fit; any of them can be shown.

import { get, ofCase } from "./api.js";
import { h, replace } from "./dom.js";
import { slicePosition } from "./geometry.js";
import { clock } from "./format.js";
import { TEXTS } from "./texts.js";

const { strip: words } = TEXTS;
// set aside for what they are or for when they were taken, not for a fault: slices for planning
const PLANNING = new Set(["no_open_hold", "not_expected", "wrong_orientation", "localizer", "geometry_differs_from_set"]);
const AT_ONCE = 200;

export function kindOf(row) {
  if (row.state !== "quarantined") return row.state;
  return PLANNING.has(row.reason_code) && row.geometry ? "planning" : "aside";
}

export function place(geometry) {
  const { mm, letter } = slicePosition(geometry);
  return words.position(letter, Math.abs(mm).toFixed(1));
}

export class SliceList {
  constructor(root, onChosen) {
    this.root = root;
    this.onChosen = onChosen;
    this.rows = [];
    this.first = 0;
    this.list = h("ol", { "aria-label": words.heading });
    this.newer = h("button", { type: "button", "aria-label": words.newer, onclick: () => this.turn(-1) }, "▲");
    this.older = h("button", { type: "button", "aria-label": words.older, onclick: () => this.turn(1) }, "▼");
    replace(root, h("div", { class: "turn" }, this.newer, this.older), this.list);
    new ResizeObserver(() => this.draw()).observe(this.list);
  }

  // Called when a slice came or was decided about; shownId: the one in the image
  async refresh(shownId) {
    this.shownId = shownId;
    this.asked = (this.asked ?? 0) + 1;
    const { asked } = this;
    const rows = await get(ofCase(`api/v1/slices?newest=true&limit=${AT_ONCE}`));
    if (asked !== this.asked) return; // a later answer came first
    this.rows = rows;
    this.draw();
  }

  shown(id) {
    this.shownId = id;
    this.draw();
  }

  fits() {
    const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const first = this.list.firstElementChild;
    const each = (first?.offsetHeight || 6.6 * rem) + 0.3 * rem;
    return Math.max(1, Math.floor((this.list.clientHeight + 0.3 * rem) / each));
  }

  turn(way) {
    const fits = this.fits();
    this.first = Math.max(0, Math.min(this.rows.length - fits, this.first + way * fits));
    this.draw();
  }

  draw() {
    if (!this.rows.length) replace(this.list, h("li", { class: "quiet" }, words.empty));
    let fits = this.fits();
    const fill = () => {
      this.first = Math.max(0, Math.min(this.first, this.rows.length - fits));
      if (this.rows.length) replace(this.list, this.rows.slice(this.first, this.first + fits).map((row) => h("li", {}, this.thumb(row))));
    };
    fill();
    const again = this.fits();
    if (again !== fits) { fits = again; fill(); }
    this.newer.disabled = this.first === 0;
    this.older.disabled = this.first + fits >= this.rows.length;
  }

  thumb(row) {
    const kind = kindOf(row);
    const where = row.geometry ? place(row.geometry) : "";
    return h("button", {
      type: "button", class: `thumb ${kind}`, disabled: !row.geometry, "aria-current": String(row.slice_id === this.shownId),
      "aria-label": words.show(row.slice_id, words.kinds[kind] ?? kind, where), title: row.reason || clock(row.received_s),
      onclick: () => this.onChosen(row),
    },
    h("img", { src: ofCase(`api/v1/slices/${row.slice_id}/image.png`), alt: "", loading: "lazy", onerror: (event) => event.target.classList.add("missing") }),
    h("span", { class: "tag" }, `${row.slice_id} ${words.kinds[kind] ?? kind}`, where ? h("br", {}) : null, where));
  }
}
