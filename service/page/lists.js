// Events, slices set aside, the case and the cases before it, targets, moving by hand.

import { get, ofCase, order } from "./api.js";
import { byId, h, replace, setHidden, setText, whenChanged } from "./dom.js";
import { act } from "./actions.js";
import { clock, day, mm, plain } from "./format.js";
import { TEXTS } from "./texts.js";

const MOST_EVENTS = 200;
const FEW_EVENTS = 8;
const FEW_ROWS = 6;

const UNSAID = new Set(["command_id", "path", "sop_instance_uid", "received_s", "frames", "assigned", "from", "code", "plan_id", "question_id", "name"]);

function oneValue(value) {
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : value.toFixed(3);
  if (Array.isArray(value)) return `(${value.map(oneValue).join(", ")})`;
  if (typeof value === "object") return Object.entries(value).map(([name, part]) => `${name} ${oneValue(part)}`).join(" ");
  return String(value);
}

// error_mm, 0.026 -> "error 0.026 mm"
function withUnit(name, text) {
  const [, what, unit] = name.match(/^(.*?)(?:_(um|mm|s))?$/);
  return `${what.replaceAll("_", " ")} ${text}${unit ? ` ${unit.replace("um", "µm")}` : ""}`;
}

// The body of an event, short: what a person wants to know at a glance.
function inWords(body) {
  return Object.entries(body)
    .filter(([name, value]) => !UNSAID.has(name) && value !== null && value !== "")
    .map(([name, value]) => (typeof value === "string" ? value : withUnit(name, oneValue(value))))
    .join(", ").slice(0, 160);
}

export function addEvent(event) {
  const list = byId("events");
  const who = event.who === "-" ? event.source : event.who;
  list.prepend(h("li", { title: TEXTS.events.from(event.event_id, event.source) },
    h("time", {}, clock(event.wall_s)),
    h("span", {}, h("b", {}, plain(event.kind)), " ", h("span", { class: "quiet" }, inWords(event.body)), " ", h("span", { class: "who" }, `(${who})`))));
  while (list.childElementCount > MOST_EVENTS) list.lastElementChild.remove();
  showFew();
}

let allEvents = false;

function showFew() {
  const rows = [...byId("events").children];
  rows.forEach((row, place) => setHidden(row, !allEvents && place >= FEW_EVENTS));
  const button = byId("events-more");
  setHidden(button, rows.length <= FEW_EVENTS);
  setText(button, allEvents ? TEXTS.events.fewer : TEXTS.events.more);
  button.onclick = () => { allEvents = !allEvents; showFew(); };
}

const opened = new Set();

// A table of at most a few rows, which a button opens: nothing scrolls inside the page.
function showTable(box, words, rows, row) {
  const name = box.id;
  if (!rows.length) return replace(box, h("p", { class: "quiet" }, words.none));
  const shown = opened.has(name) ? rows : rows.slice(0, FEW_ROWS);
  const table = h("table", {}, h("thead", {}, h("tr", {}, words.columns.map((column) => (column ? h("th", { scope: "col" }, column) : h("td", {}))))), h("tbody", {}, shown.map(row)));
  const toggle = () => { if (!opened.delete(name)) opened.add(name); showTable(box, words, rows, row); };
  replace(box, table, rows.length > FEW_ROWS ? h("button", { type: "button", class: "small more", onclick: toggle }, opened.has(name) ? TEXTS.events.fewer : TEXTS.events.more) : null);
}

// A hold that lacks slices keeps the next ones waiting until somebody says that none will come.
// Made once and left alone: a list that is drawn anew must not change the number that was typed.
const giveUp = whenChanged((offered) => {
  const words = TEXTS.aside;
  const input = h("input", { id: "lacking-hold", type: "number", min: 1, step: 1, required: true, size: 5 });
  const form = h("form", {
    class: "row more",
    onsubmit: (event) => {
      event.preventDefault();
      act(() => order("POST", `api/v1/holds/${input.valueAsNumber}/give-up`, { why: words.giveUpWhy }));
    },
  }, h("label", { htmlFor: "lacking-hold" }, words.giveUp), input, h("button", { class: "small" }, words.giveUpButton));
  replace(byId("give-up"), offered ? form : null);
});

// Slices that were set aside, each with its reason, and the way back into a hold.
export async function drawAside(state, role) {
  const words = TEXTS.aside;
  const count = state.slices.quarantined ?? 0;
  setText(byId("aside-count"), count ? String(count) : "");
  const rows = await get(ofCase("api/v1/slices?state=quarantined&newest=true&limit=30"));
  showTable(byId("aside"), words, rows, (row) => h("tr", {},
    h("td", { class: "left" }, h("a", { href: ofCase(`api/v1/slices/${row.slice_id}/image.png?scale=4`), target: "_blank", rel: "noopener" }, String(row.slice_id))),
    h("td", { class: "left" }, clock(row.received_s)),
    h("td", { class: "left" }, row.reason || plain(row.reason_code)),
    h("td", {}, role === "operator" && row.offered_hold_id ? useAtHold(row, words) : null)));
  giveUp(role === "operator" && rows.length > 0);
}

// A slice is offered only for the hold that it can be of, and whoever says so says why.
function useAtHold(row, words) {
  const hold = row.offered_hold_id;
  const ask = (event) => {
    const why = h("input", { required: true, maxLength: 500, "aria-label": words.why, placeholder: words.why });
    const form = h("form", {
      class: "row",
      onsubmit: (submitted) => {
        submitted.preventDefault();
        act(() => order("POST", `api/v1/slices/${row.slice_id}/assignment`, { hold_id: hold, why: why.value }));
      },
    }, why, h("button", { class: "small" }, words.use(hold)));
    event.target.replaceWith(form);
    why.focus();
  };
  return h("button", { type: "button", class: "small", onclick: ask }, words.use(hold));
}

export const drawCase = whenChanged(({ description, case_uid, role }) => {
  const words = TEXTS.caseCard;
  const input = (name, text, value) => [h("label", { htmlFor: `case-${name}` }, text), h("input", { id: `case-${name}`, name, value: value ?? "", maxLength: 200, disabled: role !== "operator" })];
  const said = h("span", { role: "status", class: "quiet" });
  const form = h("form", {
    class: "fields",
    onsubmit: async (event) => {
      event.preventDefault();
      const fields = Object.fromEntries(new FormData(form));
      if (await act(() => order("PUT", "api/v1/case", fields))) setText(said, words.saved);
    },
  },
  input("label", words.label, description?.label), input("operator", words.operator, description?.operator),
  input("note", words.note, description?.note),
  h("span", {}), h("p", { class: "row" }, h("button", { disabled: role !== "operator" }, words.save), said));
  const papers = h("p", { class: "papers" },
    h("a", { href: "api/v1/report", target: "_blank", rel: "noopener" }, words.report),
    h("a", { href: "api/v1/export", download: "" }, words.exported));
  replace(byId("case"), form, papers, h("p", { class: "quiet" }, words.about(case_uid)));
});

// Every target that was set in this case: one that was approached before can be taken again.
export async function drawTargets(role) {
  const words = TEXTS.targets;
  const targets = (await get(ofCase("api/v1/targets"))).reverse().slice(0, 30);
  showTable(byId("targets"), words, targets, (one) => h("tr", {},
    h("td", { class: "left" }, one.label || clock(one.set_s), one.in_water ? words.tissue : ""),
    h("td", { class: "left" }, one.patient_mm.map((value) => mm(value)).join(", ")),
    h("td", { class: "left" }, String(one.approaches.length)),
    h("td", {}, one.current ? h("b", {}, words.current) : h("button", {
      type: "button", class: "small", disabled: role !== "operator", "aria-label": words.againLabel(one.label || clock(one.set_s)),
      onclick: () => act(() => order("POST", `api/v1/targets/${one.number}/choose`)),
    }, words.again))));
}

function papersOf(folder) {
  const of = `?case=${encodeURIComponent(folder)}`;
  const words = TEXTS.past;
  return [
    h("a", { href: `api/v1/report${of}`, target: "_blank", rel: "noopener", "aria-label": words.reportOf(folder) }, words.report),
    h("a", { href: `api/v1/export${of}`, download: "", "aria-label": words.exportOf(folder) }, words.zip),
  ];
}

export async function drawPast() {
  const cases = await get("api/v1/cases");
  showTable(byId("past"), TEXTS.past, cases, (one) => h("tr", {},
    h("td", { class: "left" }, one.current ? h("b", {}, one.label || one.folder) : h("a", { href: `?case=${encodeURIComponent(one.folder)}` }, one.label || one.folder)),
    h("td", { class: "left" }, one.created_s ? day(one.created_s) : ""),
    h("td", { class: "left" }, String(one.slices)), h("td", { class: "left" }, String(one.measurements)), h("td", { class: "left" }, String(one.punctures)),
    h("td", { class: "papers" }, papersOf(one.folder))));
}

const STEPS_MM = [1, 0.1];

export const drawJog = whenChanged(({ positions_um, possible }) => {
  const words = TEXTS.jog;
  const rows = Object.entries(positions_um).map(([axis, um]) => {
    const button = (by) => h("button", {
      type: "button", class: "small", disabled: !possible, "aria-label": words.button(axis, by),
      onclick: () => act(() => order("POST", "api/v1/jog", { axis, distance_um: Math.round(1000 * by) })),
    }, `${by > 0 ? "+" : "−"}${Math.abs(by)}`);
    return h("div", { class: "row" }, h("b", {}, axis), button(-STEPS_MM[0]), button(-STEPS_MM[1]),
      h("output", {}, `${mm(um / 1000, 3)} mm`), button(STEPS_MM[1]), button(STEPS_MM[0]));
  });
  const lock = h("p", { class: "more" }, h("button", { type: "button", disabled: !possible, onclick: () => act(() => order("POST", "api/v1/lock")) }, words.lock));
  replace(byId("jog-body"), rows.length ? [...rows, lock] : words.noLink,
    possible ? null : h("p", { class: "quiet more" }, words.when));
});
