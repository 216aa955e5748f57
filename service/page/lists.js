// Events, alarms, slices set aside, the case and the cases before it, moving by hand.

import { get, order } from "./api.js";
import { byId, h, replace, whenChanged } from "./dom.js";
import { act } from "./actions.js";
import { clock, day, mm, plain } from "./format.js";

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

// A hold that lacks slices keeps the next ones waiting until somebody says that none will come.
// Made once and left alone: a list that is drawn anew must not change the number that was typed.
const giveUp = whenChanged((offered) => {
  const input = h("input", { id: "lacking-hold", type: "number", min: 1, step: 1, required: true });
  const form = h("form", {
    class: "give-up",
    onsubmit: (event) => {
      event.preventDefault();
      act(() => order("POST", `api/v1/holds/${input.valueAsNumber}/give-up`, { why: "said on the page" }));
    },
  }, h("label", { htmlFor: "lacking-hold" }, "No more slices will come of hold "), input, " ", h("button", {}, "Give them up"));
  replace(byId("give-up"), offered ? form : null);
});

// Slices that were set aside, each with its reason, and the way back into a hold.
export async function drawAside(state, role) {
  const count = state.slices.quarantined ?? 0;
  byId("aside-count").textContent = count ? String(count) : "";
  const rows = await get("api/v1/slices?state=quarantined&newest=true&limit=30");
  const hold = state.hold;
  const table = h("table", {}, h("thead", {}, h("tr", {}, ["Slice", "Received", "Why", ""].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, rows.map((row) => h("tr", {},
      h("td", { class: "left" }, h("a", { href: `api/v1/slices/${row.slice_id}/image.png?scale=4`, target: "_blank", rel: "noopener" }, String(row.slice_id))),
      h("td", { class: "left" }, clock(row.received_s)),
      h("td", { class: "left" }, row.reason || plain(row.reason_code)),
      h("td", {}, role === "operator" && hold && row.geometry ? h("button", {
        type: "button", onclick: () => act(() => order("POST", `api/v1/slices/${row.slice_id}/assignment`, { hold_id: hold.hold_id })),
      }, `Use at hold ${hold.hold_id}`) : null)))));
  replace(byId("aside"), rows.length ? table : h("p", { class: "quiet" }, "None."));
  giveUp(role === "operator" && rows.length > 0);
}

export const drawCase = whenChanged(({ description, case_uid, role }) => {
  const input = (name, words, value) => [h("label", { htmlFor: `case-${name}` }, words), h("input", { id: `case-${name}`, name, value: value ?? "", maxLength: 200, disabled: role !== "operator" })];
  const form = h("form", {
    onsubmit: (event) => {
      event.preventDefault();
      const fields = Object.fromEntries(new FormData(form));
      act(() => order("PUT", "api/v1/case", fields));
    },
  },
  input("label", "Name of the case", description?.label), input("operator", "Operator", description?.operator),
  input("note", "Note", description?.note),
  h("button", { disabled: role !== "operator" }, "Save"));
  const papers = h("p", { class: "papers" },
    h("a", { href: "api/v1/report", target: "_blank", rel: "noopener" }, "Report of this case"),
    h("a", { href: "api/v1/export", download: "" }, "Export it as a zip"));
  replace(byId("case"), form, papers, h("p", { class: "quiet" }, `Case ${case_uid || "not begun"}. No patient's name here: the record is exported as it is.`));
});

// Every target that was set in this case: one that was approached before can be taken again.
export async function drawTargets(role) {
  const targets = (await get("api/v1/targets")).reverse().slice(0, 30);
  const table = h("table", {}, h("thead", {}, h("tr", {}, ["Target", "Patient mm", "Approached", ""].map((name) => h("th", { scope: "col" }, name)))),
    h("tbody", {}, targets.map((one) => h("tr", {},
      h("td", { class: "left" }, one.label || clock(one.set_s), one.in_water ? " (in tissue)" : ""),
      h("td", { class: "left" }, one.patient_mm.map((value) => mm(value)).join(", ")),
      h("td", {}, String(one.approaches.length)),
      h("td", {}, one.current ? h("b", {}, "now") : h("button", {
        type: "button", disabled: role !== "operator", "aria-label": `Take target ${one.label || clock(one.set_s)} again`,
        onclick: () => act(() => order("POST", `api/v1/targets/${one.number}/choose`)),
      }, "Take again"))))));
  replace(byId("targets"), targets.length ? table : h("p", { class: "quiet" }, "None yet."));
}

function papersOf(folder) {
  const of = `?case=${encodeURIComponent(folder)}`;
  return [
    h("a", { href: `api/v1/report${of}`, target: "_blank", rel: "noopener", "aria-label": `Report of ${folder}` }, "report"),
    h("a", { href: `api/v1/export${of}`, download: "", "aria-label": `Export of ${folder}` }, "zip"),
  ];
}

export async function drawPast() {
  const cases = await get("api/v1/cases");
  const table = h("table", {}, h("thead", {}, h("tr", {}, ["Case", "Begun", "Slices", "Measured", "Punctured", "Papers"].map((name) => h("th", { scope: "col" }, name)))),
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
      onclick: () => act(() => order("POST", "api/v1/jog", { axis, distance_um: Math.round(1000 * by) })),
    }, `${by > 0 ? "+" : "−"}${Math.abs(by)}`);
    return h("div", { class: "row" }, h("b", {}, axis), button(-STEPS_MM[0]), button(-STEPS_MM[1]),
      h("output", {}, `${mm(um / 1000, 3)} mm`), button(STEPS_MM[1]), button(STEPS_MM[0]));
  });
  const lock = h("p", {}, h("button", { type: "button", disabled: !possible, onclick: () => act(() => order("POST", "api/v1/lock")) }, "Lock motion for the needle"));
  replace(byId("jog-body"), rows.length ? [...rows, lock] : "No link to the robot.",
    possible ? null : h("p", { class: "quiet" }, "Only while no procedure runs, the robot is armed and not locked."));
});
