// Requests to the service. What is refused is a Refusal whose text says what to do.

import { TEXTS } from "./texts.js";

export class Refusal extends Error {
  constructor(status, problem) {
    super(problem.detail || problem.title || TEXTS.refusal.status(status));
    this.status = status;
    this.code = problem.title ?? "";
  }
}

// Of which case is read: of the room's own (empty), or of one before it.
const caseName = new URLSearchParams(location.search).get("case") ?? "";
export const readsOldCase = () => caseName;

// The address of something that is read of the case that is looked at.
export function ofCase(path) {
  return caseName ? `${path}${path.includes("?") ? "&" : "?"}case=${encodeURIComponent(caseName)}` : path;
}

let csrf = "";
export const useCsrf = (token) => { csrf = token ?? ""; };

async function request(method, path, body, headers = {}) {
  let answer;
  try {
    answer = await fetch(path, {
      method,
      cache: method === "GET" ? "default" : "no-store",
      credentials: "same-origin",
      headers: {
        ...(body === undefined ? {} : { "Content-Type": "application/json" }),
        ...(csrf && method !== "GET" ? { "X-CSRF-Token": csrf } : {}),
        ...headers,
      },
      body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch {
    throw new Refusal(0, { detail: TEXTS.refusal.noAnswer });
  }
  if (answer.ok) return answer;
  let problem = {};
  try {
    problem = await answer.json();
  } catch {
    // not a problem document: the status has to do
  }
  throw new Refusal(answer.status, problem);
}

// crypto.randomUUID exists on HTTPS only; this page must also work on plain HTTP.
function onceKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

export async function get(path) {
  return (await request("GET", path)).json();
}

export async function getText(path) {
  return (await request("GET", path)).text();
}

export async function getPixels(path) {
  const answer = await request("GET", path);
  const values = new Float32Array(await answer.arrayBuffer());
  const [rows, cols] = answer.headers.get("X-Shape").split(",").map(Number);
  return { values, rows, cols };
}

// An order says when it was given, by the service's own clock as its last beat told it: one that a
// browser held back is not carried out late.
let clockAheadS = null;
export const heardClock = (clockS) => { clockAheadS = clockS - performance.now() / 1000; };
const askedAt = () => (clockAheadS === null ? {} : { "X-Asked-At": (clockAheadS + performance.now() / 1000).toFixed(3) });

// A command that is sent twice (a lost answer, a double click) is carried out once.
export async function order(method, path, body = {}) {
  const answer = await request(method, path, body, { "Idempotency-Key": onceKey(), ...askedAt() });
  return answer.status === 204 || answer.status === 202 ? null : answer.json();
}

// What became of it: stopped, on_its_way or not_delivered.
export async function stopRobot(emergency = false) {
  const answer = await request("POST", "api/v1/stop", { emergency });
  return (await answer.json()).outcome;
}
