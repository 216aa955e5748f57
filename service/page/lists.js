// Events, alarms, slices set aside, the case and the cases before it, moving by hand.

import { get, order } from "./api.js";
import { byId, h, replace, whenChanged } from "./dom.js";
import { act } from "./next.js";
import { clock, day, mm, plain } from "./words.js";

const MOST_EVENTS = 200;

const UNSAID = new Set(["command_id", "path", "sop_instance_uid", "received_s", "frames", "assigned", "from", "code", "plan_id", "question_id", "name"]);

function oneValue(value) {
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : value.toFixed(3);
  if (Array.isArray(value)) return `(${value.map(oneValue).join(", ")})`;
  if (typeof value === "object") return Object.entries(value).map(([name, part]) => `${name} ${oneValue(part)}`).join(" ");
  return String(value);
}

// The body of an event, short: what a person wants to know at a glance.
function inWords(body) {
  return Object.entries(body)
    .filter(([name, value]) => !UNSAID.has(name) && value !== null && value !== "")
    .map(([name, value]) => (typeof value === "string" ? value : `${name.replace(/_(um|mm|s)$/, "").replaceAll("_", " ")} ${oneValue(value)}`))
    .join(", ").slice(0, 160);
}

export function addEvent(event) {
  const list = byId("events");
  const item = h("li", { title: `event ${event.event_id}, from ${event.source}` },
    h("time", {}, clock(event.wall_s)),
    h("span", {}, h("b", {}, plain(event.kind)), " ", h("span", { class: "quiet" }, inWords(event.body))),
    h("span", { class: "who" }, event.who === "-" ? event.source : event.who));
  list.prepend(item);
  while (list.childElementCount > MOST_EVENTS) list.lastElementChild.remove();
}

export const drawAlarms = whenChanged((alarms) => {
  const rows = alarms.map((alarm) => h("li", { class: alarm.severity },
    h("time", {}, clock(alarm.since_s)), h("span", {}, h("b", {}, alarm.text)), h("span", { class: "who" }, alarm.what_to_do)));
  replace(byId("alarms"), rows.length ? rows : h("li", { class: "none" }, "None."));
});

// Slices that were set aside, each with its reason, and the way back into a hold.
export async function drawAside(state, role) {
  const count = state.slices.quarantined ?? 0;
  byId("aside-count").textContent = count ? String(count) : "";
  const rows = await get("/api/v1/slices?state=quarantined&newest=true&limit=30");
  const hold = state.hold;
  const table = h("table", {}, h("thead", {}, h("tr", {}, ["Slice", "Received", "Why", ""].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, rows.map((row) => h("tr", {},
      h("td", { class: "left" }, h("a", { href: `/api/v1/slices/${row.slice_id}/image.png?scale=4`, target: "_blank", rel: "noopener" }, String(row.slice_id))),
      h("td", { class: "left" }, clock(row.received_s)),
      h("td", { class: "left" }, row.reason || plain(row.reason_code)),
      h("td", {}, role === "operator" && hold && row.geometry ? h("button", {
        type: "button", onclick: () => act(() => order("POST", `/api/v1/slices/${row.slice_id}/assignment`, { hold_id: hold.hold_id })),
      }, `Use at hold ${hold.hold_id}`) : null)))));
  replace(byId("aside"), rows.length ? table : h("p", { class: "quiet" }, "None."));
}

export const drawCase = whenChanged(({ description, case_uid, role }) => {
  const input = (name, words, value) => [h("label", { htmlFor: `case-${name}` }, words), h("input", { id: `case-${name}`, name, value: value ?? "", maxLength: 200, disabled: role !== "operator" })];
  const form = h("form", {
    onsubmit: (event) => {
      event.preventDefault();
      const fields = Object.fromEntries(new FormData(form));
      act(() => order("PUT", "/api/v1/case", fields));
    },
  },
  input("label", "Name of the case", description?.label), input("operator", "Operator", description?.operator),
  input("note", "Note", description?.note),
  h("button", { disabled: role !== "operator" }, "Save"));
  const papers = h("p", { class: "papers" },
    h("a", { href: "/api/v1/report", target: "_blank", rel: "noopener" }, "Report of this case"),
    h("a", { href: "/api/v1/export", download: "" }, "Export it as a zip"));
  replace(byId("case"), form, papers, h("p", { class: "quiet" }, `Case ${case_uid || "not begun"}. No patient's name here: the record is exported as it is.`));
});

function papersOf(folder) {
  const of = `?case=${encodeURIComponent(folder)}`;
  return [
    h("a", { href: `/api/v1/report${of}`, target: "_blank", rel: "noopener", "aria-label": `Report of ${folder}` }, "report"),
    h("a", { href: `/api/v1/export${of}`, download: "", "aria-label": `Export of ${folder}` }, "zip"),
  ];
}

export async function drawPast() {
  const cases = await get("/api/v1/cases");
  const table = h("table", {}, h("thead", {}, h("tr", {}, ["Case", "Begun", "Slices", "Measurements", "Punctures", "To take along"].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, cases.map((one) => h("tr", {},
      h("td", { class: "left" }, one.current ? h("b", {}, one.label || one.folder) : one.label || one.folder),
      h("td", { class: "left" }, one.created_s ? day(one.created_s) : ""),
      h("td", {}, String(one.slices)), h("td", {}, String(one.measurements)), h("td", {}, String(one.punctures)), h("td", { class: "papers" }, papersOf(one.folder))))));
  replace(byId("past"), cases.length ? table : h("p", { class: "quiet" }, "None."));
}

const STEPS_MM = [1, 0.1];

export const drawJog = whenChanged(({ positions_um, possible }) => {
  const rows = Object.entries(positions_um).map(([axis, um]) => {
    const button = (by) => h("button", {
      type: "button", disabled: !possible, "aria-label": `${axis} ${by > 0 ? "plus" : "minus"} ${Math.abs(by)} mm`,
      onclick: () => act(() => order("POST", "/api/v1/jog", { axis, distance_um: Math.round(1000 * by) })),
    }, `${by > 0 ? "+" : "−"}${Math.abs(by)}`);
    return h("div", { class: "row" }, h("b", {}, axis), button(-STEPS_MM[0]), button(-STEPS_MM[1]),
      h("output", {}, `${mm(um / 1000, 3)} mm`), button(STEPS_MM[1]), button(STEPS_MM[0]));
  });
  const lock = h("p", {}, h("button", { type: "button", disabled: !possible, onclick: () => act(() => order("POST", "/api/v1/lock")) }, "Lock motion for the needle"));
  replace(byId("jog-body"), rows.length ? [...rows, lock] : "No link to the robot.",
    possible ? null : h("p", { class: "quiet" }, "Only while no procedure runs, the robot is armed and not locked."));
});
