// The case as a thing: begin one, finish it, go on with one of another day; and what waits outside.

import { order } from "./api.js";
import { act } from "./actions.js";
import { byId, h, replace, setHidden, whenChanged } from "./dom.js";
import { clock } from "./format.js";
import { TEXTS } from "./texts.js";

const T = TEXTS.caseDesk;

// What ends a case is not under the pointer at once: a click that was meant for another button.
const READ_FIRST_MS = 700;

const field = (name, words) => [
  h("label", { htmlFor: `new-${name}` }, words),
  h("input", { id: `new-${name}`, name, maxLength: name === "note" ? 2000 : 200, autocomplete: "off" }),
];

function newCase() {
  const form = h("form", {
    class: "new-case",
    onsubmit: (event) => {
      event.preventDefault();
      act(() => order("POST", "api/v1/cases", Object.fromEntries(new FormData(form))));
    },
  }, field("label", T.label), field("operator", T.operator), field("note", T.note),
  h("p", {}, h("button", { class: "main" }, T.start)));
  return form;
}

function finishCase() {
  const box = h("div", { class: "finish-case" });
  const closed = () => replace(box, h("button", { type: "button", class: "plain", onclick: opened }, T.finish));
  const opened = () => {
    const park = h("input", { type: "checkbox" });
    const finish = h("button", {
      type: "button", disabled: true,
      onclick: () => act(() => order("POST", "api/v1/case/finish", { park: park.checked })),
    }, T.finishNow);
    setTimeout(() => { finish.disabled = false; }, READ_FIRST_MS);
    replace(box,
      h("p", {}, T.finishWhy),
      h("p", {}, h("label", {}, park, " ", T.park)),
      h("p", {}, h("button", { type: "button", onclick: closed }, T.notYet), " ", finish));
  };
  closed();
  return box;
}

const goOn = () => h("div", { class: "go-on" },
  h("button", { type: "button", class: "main", onclick: () => act(() => order("POST", "api/v1/case/continue")) }, T.goOn));

// Made once for each of its ways and left alone: what was typed must stay.
export const drawCaseDesk = whenChanged(({ folder, begins, asks, role, busy }) => {
  const box = byId("case-desk");
  const may = begins && role === "operator";
  setHidden(box, !may);
  if (!may) return replace(box);
  if (!folder) return replace(box, newCase());
  replace(box, asks ? goOn() : null, busy ? null : finishCase());
});

export const drawHolding = whenChanged(({ holding, folder, role, busy }) => {
  setHidden(byId("card-holding"), holding.length === 0);
  const take = (held) => h("button", {
    type: "button", disabled: busy,
    onclick: () => act(() => order("POST", "api/v1/holding/take", { study: held.study })),
  }, T.take);
  const rows = holding.map((held) => h("tr", {},
    h("td", { class: "left" }, TEXTS.count(held.slices, "slice"), held.description ? `, ${held.description}` : ""),
    h("td", { class: "left" }, clock(held.first_received_s), held.slices > 1 ? ` to ${clock(held.last_received_s)}` : ""),
    h("td", { class: "left" }, held.reason),
    h("td", {}, folder && held.may_be_taken && role === "operator" ? take(held) : null)));
  const head = T.columns.map((name) => (name ? h("th", { scope: "col" }, name) : h("td", {})));
  replace(byId("holding"), h("table", {}, h("thead", {}, h("tr", {}, head)), h("tbody", {}, rows)));
});
