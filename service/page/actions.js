// What the operator does next: the prompt in words, the open question, and the possible actions.

import { order } from "./api.js";
import { StandForm } from "./arming.js";
import { byId, h, replace, setText, whenChanged } from "./dom.js";
import { mm } from "./format.js";
import { planTable } from "./plan_table.js";
import { TEXTS } from "./texts.js";

const { next: words, chips } = TEXTS;

// A plan that has just appeared must be read before it can be confirmed: no accidental double click.
const READ_FIRST_MS = 700;

const post = (path, body) => () => order("POST", `api/v1/${path}`, body);

// Arming says where the stages stand, where they lost count of it.
const asksWhere = (action, robot) => action.code === "reset" && Object.keys(robot.taken_um ?? {}).length > 0;
const keyOf = (robot) => (action) => [action.label, asksWhere(action, robot) ? [robot.taken_um, robot.taken_from] : null];

// Which actions make sense now. Green is only what the prompt asks for.
export function actionsFor(state) {
  const { robot } = state;
  const idle = !state.procedure;
  const free = idle && robot.linked && !robot.stopped && robot.armed && !state.ready && !robot.insertion_locked;
  const list = [];
  const add = (code, label, run, possible) => { if (possible) list.push({ code, label, run }); };
  if (!state.case_folder) return list; // see case_desk.js
  if (state.case_question) {
    add("needle-out", words.needleOut, "needle-out", robot.linked && robot.insertion_locked);
    return list;
  }
  add("reset", robot.stopped ? words.rearm : words.arm, post("reset"),
    robot.linked && !robot.moving && (robot.stopped || !robot.armed || !robot.position_certain));
  add("puncture", words.puncture, "puncture", state.ready && robot.insertion_locked && !state.punctured);
  const planned = state.target_patient_mm && (!state.guide || state.entry_patient_mm);
  add("approach", words.approach, post("approach"), free && state.calibrated && planned);
  add(state.target_patient_mm ? "entry" : "target", words.pick, "pick", free && state.calibrated && !planned && state.slice);
  add("calibration", words.calibrate, "calibration", free);
  add("target-here", words.targetHere, post("target/here"), free && state.calibrated && !state.guide);
  const wanted = state.acquisition_request;
  add("acquisition", words.acquired(wanted?.hold_id), post("acquisition", { hold_id: wanted?.hold_id }), state.arrival_mode && wanted);
  add("abort", words.abort, post("abort"), !idle);
  // last and apart, never where another button has been: it takes two steps besides
  add("needle-out", words.needleOut, "needle-out", robot.linked && (state.ready || robot.insertion_locked));
  return list;
}

const drawChips = whenChanged((robot) => {
  const chip = (text, kind) => h("li", { class: kind }, text);
  replace(byId("chips"), robot.linked ? [
    robot.stopped ? chip(chips.stopped, "bad") : chip(robot.armed ? chips.armed : chips.notArmed, robot.armed ? "on" : ""),
    chip(robot.moving ? chips.moving : chips.still, robot.moving ? "hot" : "on"),
    robot.insertion_locked ? chip(chips.locked, "hot") : null,
    robot.position_certain ? null : chip(chips.uncertain, "bad"),
    robot.fault ? chip(chips.fault(robot.fault), "bad") : null,
  ] : [chip(chips.noLink, "bad")]);
});

export class Next {
  // onPick: begins to pick a target on the slice
  constructor(onPick) {
    this.onPick = onPick;
    this.drawActions = whenChanged((key, state) => this.actions(state));
    this.drawQuestion = whenChanged((question, state) => this.question(question, state));
    this.standForm = new StandForm(act);
    this.mayAct = true;
  }

  draw(state, role) {
    this.mayAct = role === "operator";
    this.state = state;
    setText(byId("prompt"), promptOf(state));
    byId("prompt").classList.toggle("ready", state.ready && !state.punctured);
    byId("prompt").classList.toggle("long", state.prompt.length > 60);
    drawChips({ linked: state.robot.linked, stopped: state.robot.stopped, armed: state.robot.armed, moving: state.robot.moving, insertion_locked: state.robot.insertion_locked, position_certain: state.robot.position_certain, fault: state.robot.fault });
    setText(byId("prompt-more"), moreOf(state));
    forgetOldRefusal(state);
    this.drawQuestion(state.question, state);
    this.drawActions([role, actionsFor(state).map(keyOf(state.robot)), state.question?.question_id, state.next_action], state);
  }

  actions(state) {
    const list = state.question ? actionsFor(state).filter((a) => a.label === words.abort) : actionsFor(state);
    replace(byId("actions"), list.map((action) => this.action(action, state)));
  }

  action({ code, label, run }, state) {
    const isMain = code === state.next_action;
    if (asksWhere({ code }, state.robot)) return this.standForm.draw(state.robot, label, isMain, this.mayAct);
    return h("button", {
      type: "button", disabled: !this.mayAct,
      class: [isMain ? "main" : "", code === "needle-out" ? "apart" : ""].join(" ").trim() || null,
      title: this.mayAct ? null : words.viewersOnly,
      onclick: () => this.run(run),
    }, label);
  }

  run(what) {
    if (what === "puncture") return this.askDepth();
    if (what === "needle-out") return this.ask(h("p", {}, words.needleOutWhy), words.needleOutSure, post("needle-out"));
    if (what === "calibration") return this.ask([h("p", {}, words.drivesWhy), this.drives()], words.drivesSure, post("calibration"));
    if (what === "pick") return this.onPick();
    return act(what);
  }

  // The second step of what is not done by one click: the answer lies below what is asked.
  ask(question, yes, run) {
    replace(byId("actions"), question,
      h("button", { type: "button", onclick: () => this.actions(this.state) }, words.cancel),
      h("button", { type: "button", class: "apart", onclick: () => act(run).then(() => this.actions(this.state)) }, yes));
  }

  drives() {
    return h("ul", {}, this.state.calibration_drives.map(({ axis, stops_mm: stops }) => h("li", {}, words.drives(axis, stops.map((at) => mm(at, 1)).filter((at, k, all) => at !== all[k - 1]).join(" → ")))));
  }

  askDepth() {
    const depth = h("input", { id: "depth", type: "number", min: 0, max: 500, step: 0.5, inputMode: "decimal" });
    const form = h("form", {
      onsubmit: (event) => {
        event.preventDefault();
        const body = depth.value === "" ? {} : { insertion_depth_mm: Number(depth.value) };
        act(() => order("POST", "api/v1/puncture", body));
      },
    }, h("p", { class: "row" }, h("label", { htmlFor: "depth" }, words.depth), depth),
    h("p", { class: "row more" }, h("button", { class: "main" }, words.puncture), h("button", { type: "button", onclick: () => this.actions(this.state) }, words.cancel)));
    replace(byId("actions"), form);
    depth.focus();
  }

  question(question, state) {
    const box = byId("question");
    box.hidden = !question;
    if (!question) return replace(box);
    const plan = question.plan;
    const enable = (on) => buttons.forEach((button) => { button.disabled = !on; });
    const answer = async (choice) => {
      enable(false); // one click is one answer
      const body = { question_id: question.question_id, choice, ...(plan ? { plan_id: plan.plan_id } : {}) };
      if (!await act(() => order("POST", "api/v1/answer", body))) enable(true);
    };
    const buttons = question.choices.map((choice) => h("button", {
      type: "button", class: choice === question.choices[0] ? "main" : null,
      id: choice === "confirm" ? "confirm" : null, disabled: true,
      onclick: () => answer(choice),
    }, labelOf(choice)));
    if (this.mayAct) setTimeout(() => enable(true), READ_FIRST_MS);
    replace(box, h("div", { class: "answers" }, buttons), plan ? planTable(plan, state) : null);
  }
}

function labelOf(choice) {
  if (choice === "confirm") return words.confirmButton;
  if (choice === "reject") return words.rejectButton;
  return choice.charAt(0).toUpperCase() + choice.slice(1);
}

function promptOf({ prompt, question, robot }) {
  if (!question?.plan || !robot.linked) return prompt;
  return words.confirm(mm(Math.hypot(...question.plan.displacement_mm), 3));
}

function moreOf(state) {
  const wanted = state.acquisition_request;
  const place = state.belief?.hold;
  if (wanted) return words.hold(wanted.hold_id, place?.place ?? 1, place?.of ?? 1, wanted.count);
  if (state.procedure) return words.running(TEXTS.procedures[state.procedure] ?? state.procedure.replaceAll("_", " "));
  return state.last_outcome ? words.last(state.last_outcome.replace(/^\w+/, (name) => TEXTS.procedures[name] ?? name)) : "";
}

// A refusal stands as long as the room is as it was when something was refused.
let refusedAt = "";
const situation = (state) => JSON.stringify([state.procedure, state.question?.question_id, state.target_patient_mm, state.ready, state.punctured,
  state.robot.linked, state.robot.armed, state.robot.stopped, state.robot.moving, state.robot.insertion_locked, state.robot.position_certain]);
let now = "";

function forgetOldRefusal(state) {
  now = situation(state);
  if (refusedAt && refusedAt !== now) showRefusal("");
}

export function showRefusal(text) {
  refusedAt = text ? now : "";
  setText(byId("refusal"), text);
}

// Carries out an order and shows why it was refused, if it was; whether it was carried out.
export async function act(run) {
  try {
    await run();
    showRefusal("");
    return true;
  } catch (error) {
    showRefusal(error.message);
    return false;
  }
}
