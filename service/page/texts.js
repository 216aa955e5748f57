// Every text of the page, in one place so that they can be read together. What the service says
// (prompts, alarms, refusals) has its own place: service/room/prompt.py and conditions.py.

const many = (count, one, more = `${one}s`) => `${count} ${count === 1 ? one : more}`;

export const TEXTS = {
  title: "AutoSPINe Navigator",
  count: many,

  phases: {
    START_UP: "Start-up", CALIBRATION: "Calibration", PLANNING: "Planning", TARGETING: "Targeting",
    MOVE_TO_TARGET: "Move to target", MANUAL: "Manual", STOP: "Stop", EMERGENCY: "Emergency",
  },
  procedures: {
    calibration: "calibration", approach: "approach", recording: "recording of the target", jog: "manual move",
    guide_calibration: "calibration (four axes)", guide_approach: "approach (four axes)", guide_recording: "recording of the needle's line",
  },
  conditions: { up: "running", old: "not responding", down: "stopped", none: "not seen yet" },
  lamp: { service: "Service", robot: "Robot", connected: "This page is connected.", notConnected: "This page is not connected.", bridge: (boot) => `Bridge session ${boot}` },

  banner: {
    connecting: "Connecting to the service …",
    unreachable: "The service cannot be reached yet. Still trying.",
    lost: (age) => `Connection lost: what you see is ${age} old. STOP is still sent, but use the stop switch at the robot.`,
    lostNow: "Connection lost. STOP is still sent, but use the stop switch at the robot.",
    emergency: "EMERGENCY: robot stopped, drives parked and without power. Attend to the patient and the needle first. Re-arm to leave this state, then measure again: parking shifts the stages slightly.",
  },

  next: {
    viewersOnly: "Viewers can look and press STOP only.",
    running: (name) => `Running: ${name}.`,
    last: (text) => `Last: ${text}.`,
    hold: (hold, place, of, wanted) => `${of > 1 ? `Position ${place} of ${of} of the shift set (hold ${hold})` : `Hold ${hold}`}: ${many(wanted, "more slice")} needed.`,
    confirm: (mm) => `Confirm the move of ${mm} mm?`,
    confirmButton: "CONFIRM MOVE", rejectButton: "Reject", cancel: "Cancel",
    arm: "Arm the robot", rearm: "Re-arm the robot",
    needleOut: "Needle withdrawn – unlock motion",
    puncture: "Record the puncture", depth: "Insertion depth, mm (optional)",
    approach: "Start the approach", pick: "Pick the target on the slice", calibrate: "Start the calibration", targetHere: "Set the target at the fiducial",
    acquired: (hold) => `Slices for hold ${hold} acquired`,
    abort: "End the procedure",
    needleOutSure: "Yes, the needle is out of the patient – unlock",
    needleOutWhy: "This unlocks motion. Is the needle out of the patient?",
    drives: (axis, stops) => `${axis}: ${stops} mm`,
    drivesWhy: "The calibration drives the stages without asking again:",
    drivesSure: "Drive the stages – calibrate",
  },
  stand: {
    heading: "Assumed stage positions", from: (source) => `From: ${source}. Read each stage's scale and correct what differs.`,
    field: (axis) => `Position of ${axis}, mm`, unit: "mm", assumed: (mm) => `mm, assumed ${mm}`,
    notNumber: "type a position in mm.", outside: (low, high) => `outside its travel, ${low} to ${high} mm.`,
    // a button does not break at this hyphen
    confirm: (arm) => `Positions are right: ${arm.toLowerCase().replace("-", "\u2011")}`,
  },
  chips: {
    stopped: "Stopped", armed: "Armed", notArmed: "Not armed", moving: "Moving", still: "Standing still",
    locked: "Motion locked for the needle", uncertain: "Position uncertain", fault: (text) => `Fault: ${text}`, noLink: "No link to the robot",
  },
  plan: {
    row: "row", col: "column", picture: "The move as seen in the slice",
    parts: { upper: "Upper fiducial", lower: "Lower fiducial", tip: "Needle tip" },
    distance: "Distance to target, before this move",
  },

  distance: {
    heading: "Distance to target", tipHeading: "Distance from needle tip to target", sigma: "(1 σ)",
    closeUp: (mm) => `Close-up: the fiducial is ${mm} mm from the target`,
    noFiducial: (why) => `No fiducial found: ${why}`, atReady: "Known when the next move is planned, and at READY.", nothing: "No target or no measurement yet.",
    lies: (where) => `The target lies ${where}.`, liesByNewest: (where) => `By the newest slices alone the target lies ${where}.`,
    within: (mm) => `Probability within ${mm} mm`, withinTitle: "that the true distance is below the tolerance",
    measured: (age, left) => `Measured ${age} ago${left}.`, goodFor: (left) => `, valid for another ${left}`,
    tipBelow: "Tip below lower joint", slices: "Slices", snr: "Signal to noise", chi2: "χ² per degree of freedom", method: "Method",
  },
  needle: {
    heading: "Needle and target from the side", picture: "Needle line, entry point, target and fiducials seen from the side",
    front: "A", back: "P", entry: "entry", target: "target", upper: "upper", lower: "lower", tip: "tip", nothing: "Set an entry point and a target.",
  },

  jog: {
    heading: "Move by hand", noLink: "No link to the robot.", lock: "Lock motion for the needle",
    when: "Only while no procedure is running and the robot is armed and not locked.",
    button: (axis, by) => `${axis} ${by > 0 ? "plus" : "minus"} ${Math.abs(by)} mm`,
  },

  image: {
    layouts: { slice: "Slice", both: "Both", reconstruction: "Reconstruction", blend: "Blended", residual: "Residual" },
    residual: "Residual", residualOf: (id, chi2, method) => `Slice ${id} − disc${chi2 ? `, χ² ${chi2} per degree of freedom (${method})` : ""}`, noResidual: "No fitted model yet.",
    which: "Image shown", window: "Window", level: "Level", auto: "Auto", blend: "Blend", smooth: "Smooth", profile: "Profile",
    zoom: "Zoom", zoomIn: "Zoom in", zoomOut: "Zoom out", whole: "Whole", fiducial: "Fiducial",
    noSlice: "No slice yet.", noReconstruction: "No reconstruction yet: it needs slices at several commanded shifts.",
    slice: (id) => `Slice ${id}`, sliceNumber: "Slice", reconstruction: "Reconstruction",
    ofMeasurement: (factor, id, earlier) => `×${factor}, measurement ${id}${earlier ? " (earlier)" : ""}`,
    earlierSlice: (id) => `Slice ${id} (not the newest)`,
    help: (name) => `${name}: arrow keys pan, plus and minus zoom, 0 shows all`, overlay: (name) => `${name} with overlay`,
    age: (id, at, age) => `Slice ${id}: received ${at}, ${age} ago`, source: (state, time) => `${state}${time ? ` · time from ${time}` : ""}`,
    cursor: (words, row, col, value) => `${words}  ·  row ${row}  column ${col}  ·  value ${value}`,
    profileOf: (row) => `Intensity along row ${row} (solid) and its column (dashed) through the fiducial, mm from its centre`,
    newest: "Newest", camera: "Camera",
  },
  strip: {
    heading: "Slices of this case", newer: "Newer slices", older: "Older slices", empty: "No slices.",
    kinds: { assigned: "used", pending: "pending", aside: "set aside", planning: "planning" },
    position: (side, mm) => `${side} ${mm}`,
    show: (id, kind, where) => `${id} ${kind}${where ? ` ${where}` : ""}: show this slice`,
  },

  pick: {
    start: "Pick target", heading: "Pick a point on the slice",
    how: "Click on the slice. Arrow keys move the point by 0.1 mm.",
    axes: ["x", "y", "z"], unit: "mm", field: (axis) => `${axis}, patient mm`, label: "Label", labelHint: "(optional)",
    inTissue: "The target is in tissue",
    inTissueWhy: "Oil in the fiducial and water in tissue appear shifted against each other in the slice. Tick this for an anatomical target: the shift is then corrected.",
    distance: (mm, where) => `${mm} mm from the fiducial${where ? `: ${where}` : ""}.`,
    reachable: "Within the robot's travel.", unreachable: (axis, mm, low, high) => `Out of reach: axis ${axis} would have to go to ${mm} mm (travel ${low} to ${high} mm).`,
    empty: (field) => `Not set: ${field} is empty.`,
    reachUnknown: "Reach is known after a calibration.",
    told: { within: () => "Within the robot's travel.", out: (why) => `Out of reach: ${why}.`, unknown: (why) => `${why.charAt(0).toUpperCase()}${why.slice(1)}.` },
    setTarget: "Set target", setEntry: "Set entry point", withdraw: "Withdraw the target", cancel: "Cancel",
    notSlice: "The point lies in the slice shown.",
  },

  history: {
    heading: "Distance to target, measurement by measurement", guide: "With two fiducials it is the needle tip that is steered; its distance is shown at READY.",
    nothing: "No measurement with a target yet.", tolerance: "tolerance", unit: "mm", axis: "no.",
    picture: (mm, tolerance) => `Last distance ${mm} mm${tolerance ? `, tolerance ${tolerance} mm` : ""}`,
    point: (mm, sigma, frames, method) => `${mm} ± ${sigma} mm, ${many(frames, "slice")}, ${method}`,
  },
  stages: { heading: "Stage positions and travel", top: "top stage", bottom: "bottom stage", noLink: "No link to the robot yet." },

  alarms: { heading: "Alarms", none: "No alarms.", todo: "What to do:", more: (count) => `${count} more`, all: "All alarms" },
  events: { heading: "Event log", more: "Show more", fewer: "Show fewer", from: (id, source) => `event ${id}, from ${source}` },
  aside: {
    heading: "Slices set aside", columns: ["Slice", "Received", "Why", ""], none: "None.", use: (hold) => `Use at hold ${hold}`, why: "Why does it belong to this hold?",
    giveUp: "No more slices will come for hold", giveUpButton: "Stop waiting for these slices", giveUpWhy: "entered on the page",
  },
  caseCard: {
    heading: "Case", label: "Case name", operator: "Operator", note: "Note", save: "Save", saved: "Saved.",
    report: "Report", print: "Printable report", exported: "Export as zip",
    about: (uid) => `Case ${uid || "not started"}. Do not enter patient names: the record is exported as it is.`,
  },
  caseDesk: {
    label: "Case name (no patient name)", operator: "Operator", note: "Note", start: "Start the case", goOn: "Continue this case",
    finish: "Finish the case …", finishNow: "Finish the case now", notYet: "Not yet", park: "Park the drives",
    finishWhy: "This disarms the robot and finishes the case. Report and export are written to its folder.",
    columns: ["What", "Received", "Why", ""], take: "Add to this case",
  },
  targets: {
    heading: "Targets of this case", columns: ["Target", "Patient mm (LPS)", "Approaches", ""], none: "None yet.", current: "current", again: "Use again",
    againLabel: (name) => `Use again: target ${name}`, tissue: " (in tissue)",
  },
  past: {
    heading: "Cases", columns: ["Case", "Started", "Slices", "Measured", "Punctures", "Documents"], none: "None.",
    report: "report", zip: "zip", reportOf: (name) => `Report of ${name}`, exportOf: (name) => `zip: export of ${name}`,
  },
  oldCase: {
    prompt: (name) => `Case ${name}: read only.`, more: "Nothing here moves the robot. STOP acts on the room as always.", back: "Back to the room",
  },
  clock: {
    heading: "Scanner clock",
    same: "agrees with the room clock", ahead: (s) => `is ${s} s ahead of the room clock`, behind: (s) => `is ${s} s behind the room clock`,
    known: (words, s, who) => `The scanner clock ${words}, ± ${s} s; ${who}`, compared: (when, who) => `compared ${when} by ${who}`, ago: "ago",
    reads: "Scanner clock reads", now: "Scanner clock reads this now", then: (words) => `The scanner clock ${words}.`,
    bad: "Type what the scanner clock reads, for example 10:32:07.", use: "Use this", forget: "The scanner clock was changed: discard this",
    forgetTitle: "Slices stay pending until the clocks are compared again.", why: "entered on the page",
  },
  system: {
    heading: "System", service: "Service", robot: "Robot", slices: "Slices", none: "none", linked: (boot, phase) => `linked, session ${boot}, in phase ${phase}`,
    counters: { autospine_link_frames_sent: "Frames sent to the robot", autospine_link_frames_resent: "Frames sent again", autospine_link_frames_bad: "Frames received damaged", autospine_viewers: "Screens open" },
    roundTrip: "Round trip to the robot", states: { assigned: "used", quarantined: "set aside", pending: "pending" },
  },
  belief: {
    heading: "What the system believes",
    calibration: "Calibration", notCalibrated: "none yet", when: (at) => `at ${at}`,
    axis: (name, scale, angle, sigma) => `${name}: ${scale} mm per mm (± ${sigma}), ${angle}° from the columns`,
    strategy: "Strategy", tolerance: "Tolerance", confidence: "Confidence", goal: (mm, percent) => `${mm} mm with ${percent}`,
    hold: "Hold", holdOf: (id, place, of) => (of > 1 ? `${id}, position ${place} of ${of} of the shift set` : String(id)),
    fiducial: "Fiducial σ", sigmaOf: (row, col) => `${row} mm along rows, ${col} mm along columns`,
    madeOf: "Made of", why: "Another slice?",
    slice: (id) => `slice ${id}`, noMeasurement: "no measurement yet",
    settings: "Change for this case", mostSlices: "Most slices at one position", apply: "Apply", applied: "Applied.",
    bounds: (low, high) => `${low} to ${high}`,
  },
  proposals: {
    heading: "Proposed by a planning station", unnamed: "unnamed", from: (sender, via, at) => `from ${sender} by ${via}, ${at}`,
    target: (where) => `Target ${where} mm (LPS)`, entry: (where) => `Entry point ${where} mm (LPS)`, notYet: (what) => `Not known yet: ${what}.`,
    noFrame: "The message does not name its frame of reference: compare the position before you accept it.",
    tissue: "Accept: target in tissue", oil: "Accept: target for the fiducial", refuse: "Refuse", why: "Why not", whyHint: "reason (optional)",
  },
  login: { heading: "Log in to AutoSPINe Navigator", token: "Your token", button: "Log in", who: (name, role) => `${name} (${role})`, leave: "Log out" },
  refusal: { noAnswer: "The service does not answer.", status: (status) => `The service answered ${status}.` },
};
