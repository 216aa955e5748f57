// What the operator does next: the prompt in words, the open question, and the possible actions.

import { order } from "./api.js";
import { byId, h, replace, s, setText, whenChanged } from "./dom.js";
import { inWords } from "./geometry.js";
import { mm, signedMm } from "./format.js";

// A plan that has just appeared must be read before it can be confirmed: no accidental double click.
const READ_FIRST_MS = 700;

const post = (path, body) => () => order("POST", `api/v1/${path}`, body);

// Which actions make sense now. The first one that is possible is the large button.
export function actionsFor(state) {
  const { robot } = state;
  const idle = !state.procedure;
  const free = idle && robot.linked && !robot.stopped && robot.armed && !state.ready && !robot.insertion_locked;
  const list = [];
  const add = (label, run, possible, extra = {}) => { if (possible) list.push({ label, run, ...extra }); };
  if (!state.case_folder) return list; // see case_desk.js
  if (state.case_question) {
    add("The needle is out: unlock", post("needle-out"), robot.linked && robot.insertion_locked);
    return list;
  }
  add(robot.stopped ? "Re-arm the robot" : "Arm the robot", post("reset"),
    robot.linked && !robot.moving && (robot.stopped || !robot.armed || !robot.position_certain));
  if (state.ready) {
    add("Record the puncture", "puncture", robot.insertion_locked && !state.punctured);
    add("The needle is out: unlock", post("needle-out"), true, { last: !state.punctured });
  } else {
    add("The needle is out: unlock", post("needle-out"), robot.linked && robot.insertion_locked);
  }
  add("Start the approach", post("approach"), free && state.calibrated && state.target_patient_mm && (!state.guide || state.entry_patient_mm));
  add("Start the calibration", post("calibration"), free);
  add("Target: where the fiducial is now", post("target/here"), free && state.calibrated && !state.guide);
  const wanted = state.acquisition_request;
  add(`The slices of hold ${wanted?.hold_id} were acquired`, post("acquisition", { hold_id: wanted?.hold_id }), state.arrival_mode && wanted);
  add("End the procedure", post("abort"), !idle);
  return list.sort((a, b) => (a.last ? 1 : 0) - (b.last ? 1 : 0));
}

const drawChips = whenChanged((robot) => {
  const chip = (words, kind) => h("li", { class: kind }, words);
  const rows = robot.linked ? [
    robot.stopped ? chip("Stopped", "bad") : chip(robot.armed ? "Armed" : "Not armed", robot.armed ? "on" : ""),
    chip(robot.moving ? "Moving" : "Standing still", robot.moving ? "hot" : "on"),
    robot.insertion_locked ? chip("Motion locked for the needle", "hot") : null,
    robot.position_certain ? null : chip("Position not certain", "bad"),
    robot.fault ? chip(`Fault: ${robot.fault}`, "bad") : null,
  ] : [chip("No link to the robot", "bad")];
  replace(byId("chips"), rows);
});

export class Next {
  constructor() {
    this.drawActions = whenChanged((key, state) => this.actions(state));
    this.drawQuestion = whenChanged((question, state) => this.question(question, state));
    this.mayAct = true;
  }

  draw(state, role) {
    this.mayAct = role === "operator";
    setText(byId("prompt"), promptOf(state));
    byId("prompt").classList.toggle("ready", state.ready);
    byId("prompt").classList.toggle("long", state.prompt.length > 80);
    drawChips({ linked: state.robot.linked, stopped: state.robot.stopped, armed: state.robot.armed, moving: state.robot.moving, insertion_locked: state.robot.insertion_locked, position_certain: state.robot.position_certain, fault: state.robot.fault });
    setText(byId("prompt-more"), this.more(state));
    this.drawQuestion(state.question, state);
    this.drawActions([role, actionsFor(state).map((action) => action.label), state.question?.question_id], state);
  }

  more(state) {
    const wanted = state.acquisition_request;
    if (wanted) return `Position of the robot: hold ${wanted.hold_id}. Slices still wanted: ${wanted.count}.`;
    if (state.procedure) return `Running: ${state.procedure.replaceAll("_", " ")}.`;
    return state.last_outcome ? `Last: ${state.last_outcome.replace(/^\w+/, (name) => name.replaceAll("_", " "))}.` : "";
  }

  actions(state) {
    const list = state.question ? actionsFor(state).filter((a) => a.label === "End the procedure") : actionsFor(state);
    const buttons = list.map((action, place) => h("button", {
      type: "button", class: place === 0 && !state.procedure ? "main" : null, disabled: !this.mayAct,
      title: this.mayAct ? null : "Viewers may look and press STOP only.",
      onclick: () => this.run(action.run),
    }, action.label));
    replace(byId("actions"), buttons);
  }

  run(what) {
    if (what === "puncture") return this.askDepth();
    return act(what);
  }

  askDepth() {
    const depth = h("input", { id: "depth", type: "number", min: 0, max: 500, step: 0.5, inputMode: "decimal" });
    const form = h("form", {
      onsubmit: (event) => {
        event.preventDefault();
        const body = depth.value === "" ? {} : { insertion_depth_mm: Number(depth.value) };
        act(() => order("POST", "api/v1/puncture", body));
      },
    }, h("label", { htmlFor: "depth" }, "Insertion depth, mm (may stay empty) "), depth,
    h("p", {}, h("button", { class: "main" }, "Record the puncture")));
    replace(byId("actions"), form);
    depth.focus();
  }

  question(question, state) {
    const box = byId("question");
    box.hidden = !question;
    if (!question) return replace(box);
    const plan = question.plan;
    const buttons = question.choices.map((choice) => h("button", {
      type: "button", class: choice === question.choices[0] ? "main" : null,
      id: choice === "confirm" ? "confirm" : null, disabled: true,
      onclick: () => act(() => order("POST", "api/v1/answer", {
        question_id: question.question_id, choice, ...(plan ? { plan_id: plan.plan_id } : {}),
      })),
    }, choice === "confirm" ? "CONFIRM MOVE" : choice.charAt(0).toUpperCase() + choice.slice(1)));
    if (this.mayAct) setTimeout(() => buttons.forEach((button) => { button.disabled = false; }), READ_FIRST_MS);
    replace(box, plan ? planTable(plan, state) : null, h("div", { class: "answers" }, buttons));
  }
}

function promptOf({ prompt, question, robot }) {
  if (!question?.plan || !robot.linked) return prompt;
  return `Confirm the move of ${mm(Math.hypot(...question.plan.displacement_mm), 3)} mm?`;
}

function planTable(plan, state) {
  const [row, col] = plan.displacement_mm;
  const reach = 1.25 * Math.max(Math.abs(row), Math.abs(col), 0.01);
  const axes = Object.entries(plan.setpoints_um).filter(([axis, um]) => um !== plan.from_um[axis]);
  return h("div", { class: "error-grid" },
    h("div", {},
      h("p", { class: "quiet" }, state.slice ? inWords(state.slice, row, col, 3) : `row ${signedMm(row)}, column ${signedMm(col)} mm`),
      h("table", {}, h("tbody", {}, axes.map(([axis, um]) => h("tr", {},
        h("th", { scope: "row" }, axis),
        h("td", {}, `${mm(plan.from_um[axis] / 1000, 3)} → ${mm(um / 1000, 3)} mm`)))))),
    s("svg", { viewBox: `${-reach} ${-reach} ${2 * reach} ${2 * reach}`, role: "img", "aria-label": "The move as the slice shows it" },
      s("path", { d: `M${-reach} 0H${reach}M0 ${-reach}V${reach}`, class: "thin", stroke: "var(--line)" }),
      s("circle", { r: reach * 0.04, class: "thin c-fiducial" }),
      arrow(0, 0, col, row, reach * 0.12)));
}

export function arrow(x0, y0, x1, y1, head) {
  const long = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [ux, uy] = [(x1 - x0) / long, (y1 - y0) / long];
  const barb = (turn) => `${x1 - head * (ux - turn * uy * 0.5)} ${y1 - head * (uy + turn * ux * 0.5)}`;
  return s("path", { d: `M${x0} ${y0}L${x1} ${y1}M${barb(1)}L${x1} ${y1}L${barb(-1)}`, class: "thin c-plan" });
}

// Carries out an order and shows why it was refused, if it was.
export async function act(run) {
  try {
    await run();
    setText(byId("refusal"), "");
  } catch (error) {
    setText(byId("refusal"), error.message);
  }
}
