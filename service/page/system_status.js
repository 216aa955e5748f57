// Every part of the room with its state, and what the line to the robot counts.

import { getText } from "./api.js";
import { byId, h, replace, setText, whenChanged } from "./dom.js";
import { plain } from "./format.js";

const EVERY_MS = 5000;
const COUNTED = [
  ["autospine_link_frames_sent", "Frames sent to the robot"],
  ["autospine_link_frames_resent", "sent again"],
  ["autospine_link_frames_bad", "received damaged"],
  ["autospine_viewers", "Screens open"],
];

let values = {};

const row = (name, value, kind) => h("tr", {}, h("th", { scope: "row" }, name), h("td", { class: kind }, value));

export const drawParts = whenChanged(({ robot, processes, slices }) => {
  const said = { up: "works", old: "does not get on", down: "has ended", none: "not seen yet" };
  const rows = [
    row("Service", "works"),
    row("Robot", robot.linked ? `linked, start ${robot.boot_id.slice(0, 8)}` : robot.problem, robot.linked ? "" : "wrong"),
    ...processes.map((one) => row(plain(one.name), said[one.condition], one.condition === "up" ? "" : "wrong")),
    row("Slices", Object.entries(slices).map(([name, count]) => `${count} ${name}`).join(", ") || "none"),
    ...COUNTED.map(([name, words]) => h("tr", {}, h("th", { scope: "row" }, words), h("td", { "data-metric": name }, ""))),
    h("tr", {}, h("th", { scope: "row" }, "Round trip to the robot"), h("td", { "data-metric": "autospine_link_round_trip_seconds" }, "")),
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
