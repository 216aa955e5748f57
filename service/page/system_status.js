// Every part of the system with its state, and what the line to the robot counts.

import { getText } from "./api.js";
import { byId, h, replace, setText, whenChanged } from "./dom.js";
import { plain } from "./format.js";
import { TEXTS } from "./texts.js";

const EVERY_MS = 5000;
const { system: words } = TEXTS;

let values = {};

const row = (name, value, kind) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: kind }, value));
const counter = (name, metric) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { "data-metric": metric }, ""));

export const drawParts = whenChanged(({ robot, processes, slices }) => {
  const rows = [
    row(words.service, TEXTS.conditions.up),
    row(words.robot, robot.linked ? words.linked(robot.boot_id.slice(0, 8), TEXTS.phases[robot.phase] ?? robot.phase) : robot.problem, robot.linked ? "" : "wrong"),
    ...processes.map((one) => row(plain(one.name), TEXTS.conditions[one.condition], one.condition === "up" ? "" : "wrong")),
    row(words.slices, Object.entries(slices).map(([name, count]) => `${count} ${words.states[name] ?? name}`).join(", ") || words.none),
    ...Object.entries(words.counters).map(([metric, name]) => counter(name, metric)),
    counter(words.roundTrip, "autospine_link_round_trip_seconds"),
  ];
  replace(byId("parts"), h("table", {}, h("tbody", {}, rows)));
  showCounters();
});

async function readCounters() {
  try {
    const lines = (await getText("metrics")).split("\n");
    values = Object.fromEntries(lines.filter((line) => line && !line.startsWith("#")).map((line) => line.split(" ")));
  } catch {
    return; // the stream says when the service is back
  }
  showCounters();
}

function showCounters() {
  for (const cell of byId("parts").querySelectorAll("[data-metric]")) {
    const value = Number(values[cell.dataset.metric]);
    const isTime = cell.dataset.metric.endsWith("_seconds");
    setText(cell, Number.isFinite(value) ? (isTime ? `${(1000 * value).toFixed(1)} ms` : String(value)) : "–");
  }
}

let counting = 0;

export function keepCounting() {
  clearInterval(counting);
  readCounters();
  counting = setInterval(() => { if (!document.hidden) readCounters(); }, EVERY_MS);
}
