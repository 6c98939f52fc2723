"use strict";
// What the mouse, fingers and keys do. begin() starts the page.

let held = null;  // what is dragged: name of a handle, "pose" or "nose"

function pointOf(event) {
  const box = $("map").getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

function near([x, y], [u, v], most) {
  return Math.hypot(x - u, y - v) <= most;
}

// The rule whose dot is under a point, the nearest of those that are drawn.
function ruleAt(point) {
  if (view.which === "none") return null;
  const c = view.chart;
  const seen = view.which === "here" ? [...rules.keys()].filter((k) => decision.shares[k] > 0.01) : listedRules();
  let best = null, least = 9;
  for (const k of seen) {
    const [x, y] = [c.px(rules[k].centre[view.a]), c.py(rules[k].centre[view.b])];
    const far = Math.hypot(point[0] - x, point[1] - y) + 3 * (1 - aboutUnseen(k));
    if (far < least) [best, least] = [rules[k], far];
  }
  return best;
}

function choose(number) {
  view.chosen = number;
  update({ ground: true, editor: true, list: true });
}

// Move the pose on the map to a point, no farther than its ends.
function moveTo([px, py]) {
  const c = view.chart;
  view.pose[view.a] = Math.min(Math.max(c.x(px), c.x0), c.x1);
  view.pose[view.b] = Math.min(Math.max(c.y(py), c.y0), c.y1);
}

function turnTo([px, py]) {
  const c = view.chart;
  view.pose[2] = Math.atan2(c.y(py) - view.pose[1], c.x(px) - view.pose[0]);
  showOthers();
}

function dragRule([px, py]) {
  const c = view.chart, rule = chosen(), x = c.x(px), y = c.y(py), { a, b } = view;
  if (held === "centre") change(["centre", a, x], ["centre", b, y]);
  if (held === "across") change(["width", a, Math.abs(x - rule.centre[a])]);
  if (held === "up") change(["width", b, Math.abs(y - rule.centre[b])]);
  if (held === "heading") change(["centre", 2, Math.atan2(y - rule.centre[1], x - rule.centre[0])]);
}

function press(event) {
  const at = pointOf(event), reach = event.pointerType === "mouse" ? 9 : 20;
  $("map").setPointerCapture(event.pointerId);
  stop();
  const grips = chosen() ? Object.entries(handles(chosen())).reverse() : [];
  const grip = grips.find(([, spot]) => near(at, spot, reach));
  if (grip) {
    held = grip[0];
    remember();
    return;
  }
  if (maze && near(at, nose(), reach)) {
    held = "nose";
    return;
  }
  const rule = ruleAt(at), c = view.chart;
  const onPose = near(at, [c.px(view.pose[view.a]), c.py(view.pose[view.b])], maze ? maze.radius * c.sx : 14);
  if (rule && !onPose) {
    choose(rule.number === view.chosen ? null : rule.number);
    return;
  }
  held = "pose";
  drag(event);
}

function drag(event) {
  if (!held) return;
  const at = pointOf(event);
  if (held === "pose") moveTo(at);
  else if (held === "nose") turnTo(at);
  else dragRule(at);
  soon({ ground: held !== "pose" || task.inputs.length > 3 + Number(policy.acting), editor: !["pose", "nose"].includes(held) });
}

function release() {
  if (!held) return;
  const edited = !["pose", "nose"].includes(held);
  if (edited && past.at(-1) === rules) past.pop();  // nothing moved
  held = null;
  update({ list: true, ground: edited, editor: edited });
}

function key(event) {
  const c = view.chart, far = (event.shiftKey ? 10 : 1) * (maze ? 0.01 : 0.01 * (c.x1 - c.x0));
  const up = (event.shiftKey ? 10 : 1) * (maze ? 0.01 : 0.01 * (c.y1 - c.y0)), turn = Math.PI / 36;
  const moves = { ArrowLeft: [-far, 0], ArrowRight: [far, 0], ArrowUp: [0, up], ArrowDown: [0, -up] };
  const turns = { "[": turn, "]": -turn };
  if (moves[event.key]) {
    const [dx, dy] = moves[event.key];
    moveTo([c.px(view.pose[view.a] + dx), c.py(view.pose[view.b] + dy)]);
    update({ ground: task.inputs.length > 3 + Number(policy.acting) });
  } else if (turns[event.key] && maze) {
    view.pose[2] = turned(view.pose[2] + turns[event.key]);
    showOthers();
    update({ ground: true });
  } else if (event.key === "Enter") {
    choose(rules[decision.order[0]].number);
  } else if (event.key === " " && maze) driving ? stop() : drive();
  else if (event.key === "Delete" || event.key === "Backspace") removeChosen();
  else if (event.key === "Escape") choose(null);
  else return;
  event.preventDefault();
}

// -------------------------------------------------------------------------------------- begin

// A slider for each input of the state that the map does not show.
function showOthers() {
  const home = $("others"), hidden = task.axes.map((_, i) => i).filter((i) => i !== view.a && i !== view.b);
  if (home.dataset.for !== hidden.join()) {
    home.dataset.for = hidden.join();
    home.innerHTML = hidden.map((i) => {
      const [low, high] = rangeOf(i);
      return `<label>${escaped(task.axes[i].name)}<input type="range" data-axis="${i}" min="${low}" max="${high}" step="any"><output></output></label>`;
    }).join("");
  }
  for (const input of home.querySelectorAll("input")) {
    const i = Number(input.dataset.axis);
    if (input !== document.activeElement || driving || held) input.value = view.pose[i];
    input.nextElementSibling.textContent = placeOn(task.axes[i], view.pose[i]);
  }
}

function listen(id, kind, act) {
  $(id).addEventListener(kind, act);
}

function pickRule(event) {
  const row = event.target.closest("tr[data-rule]");
  if (row) choose(Number(row.dataset.rule));
}

function connect() {
  for (const [kind, act] of Object.entries({ pointerdown: press, pointermove: drag, pointerup: release, pointercancel: release, keydown: key })) listen("map", kind, act);
  listen("undo", "click", () => undo());
  listen("redo", "click", () => undo(future, past));
  listen("save", "click", save);
  listen("theme", "click", () => {
    const root = document.documentElement, dark = getComputedStyle(root).getPropertyValue("--card").trim() !== "#ffffff";
    root.dataset.theme = dark ? "light" : "dark";
    layout();
    update({ list: true, editor: true });
  });
  listen("field", "change", () => { view.field = $("field").value; update({ ground: true }); showLegend(); });
  listen("which", "change", () => { view.which = $("which").value; update({ ground: true }); });
  for (const end of ["a", "b"]) {
    listen(`axis-${end}`, "change", () => {
      const other = end === "a" ? "b" : "a", old = view[end];
      view[end] = Number($(`axis-${end}`).value);
      if (view[other] === view[end]) view[other] = old;
      $(`axis-${other}`).value = view[other];
      showOthers();
      layout();
    });
  }
  listen("others", "input", (event) => {
    stop();
    view.pose[Number(event.target.dataset.axis)] = Number(event.target.value);
    showOthers();
    soon({ ground: true });
  });
  listen("drive", "click", () => (driving ? stop() : drive()));
  listen("home", "click", () => { stop(); toStart(); update({ ground: true }); });
  listen("voices", "click", pickRule);
  listen("rules", "click", (event) => {
    const head = event.target.closest("button[data-sort]");
    if (!head) return pickRule(event);
    const name = head.dataset.sort, [old, way] = view.sort;
    view.sort = [name, name === old ? -way : ["number", "moment", "born"].includes(name) || name.startsWith("in") ? 1 : -1];
    showList();
    document.querySelector(`#rules button[data-sort="${name}"]`).focus();
  });
  for (const id of ["search", "votes", "fired", "outvoted", "near"]) listen(id, "input", () => update({ ground: true, list: true }));
  listen("more", "click", () => { view.all = true; showList(); });
  listen("visit", "click", () => { stop(); view.pose = view.pose.map((v, i) => chosen().centre[i]); showOthers(); update({ ground: true, list: true }); });
  listen("copy", "click", copyHere);
  listen("remove", "click", removeChosen);
  listen("editor", "submit", (event) => event.preventDefault());
  let begun = null;  // a drag of a slider is one change
  listen("editor", "input", ({ target }) => {
    const [part, i] = target.dataset.key.split("-"), scale = part === "consequents" ? 1 : shown(task.inputs[i]).scale;
    if (target.value === "" || !Number.isFinite(target.valueAsNumber)) return;
    if (begun !== target) remember();
    begun = target;
    change([part, Number(i), target.valueAsNumber / scale]);
    soon({ ground: true, editor: true });
  });
  listen("editor", "change", () => { begun = null; update({ list: true, editor: true }); });
  listen("trial", "input", () => { halt(); toTrial(Number($("trial").value)); });
  listen("play", "click", play);
  window.addEventListener("resize", layout);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", layout);
  window.addEventListener("keydown", (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.target.matches("input[type=number], input[type=search]")) return;
    const letter = event.key.toLowerCase();
    if (letter === "z" && !event.shiftKey) undo();
    else if (letter === "y" || letter === "z") undo(future, past);
    else return;
    event.preventDefault();
  });
}

function describe() {
  const { learner } = task;
  document.title = `${data.name}: rule lab`;
  $("run").textContent = data.name;
  const trials = `${data.trial.toLocaleString("en")} trial${data.trial === 1 ? "" : "s"} learned`;
  $("summary").textContent = `${maze ? "maze" : task.task}, ${learner === "q" ? "Q-learning" : learner.toUpperCase()}, ${rules.length.toLocaleString("en")} rules, ${trials}`;
  $("map-help").textContent = maze
    ? "Drag the robot or click the floor to move it; drag the small circle ahead of it to turn it. Click a rule, then drag its centre, its widths or its heading."
    : "Click or drag to move the state; the sliders set what the map does not show. Click a rule, then drag its centre or its widths.";
  $("fine").textContent = [
    "What is shown is the plain policy, its mean or greedy action: without exploration, and without the chance by which an evaluation leaves loops.",
    maze ? `The robot here is kinematics: wheels of at most 10 mm/s that roll without slip, an action held for ${task.robot.hold} steps of ${task.robot.seconds} s or until it touches a wall, along which it slides; it knows its pose exactly. The simulator has masses, tyres and an estimated pose, so steps differ.` : "The page does not simulate this task.",
    "Saved rules become a run by python -m sofnn_torch.rules RUN --load FILE.",
  ].join(" ");
  const names = task.choices.map((name, j) => `<option value="${j}">${escaped(name)}</option>`);
  if (names.length) $("votes").innerHTML += names.join("") + (policy.acting || task.decision.kind === "normal" ? "" : '<option value="undecided">undecided</option>');
  else $("votes").parentElement.hidden = true;
  $("outvoted").parentElement.hidden = policy.acting || !names.length;
  $("axes").hidden = Boolean(maze);
  for (const [end, chosenAxis] of [["a", view.a], ["b", view.b]]) {
    $(`axis-${end}`).innerHTML = task.axes.map((axis, i) => `<option value="${i}">${escaped(axis.name)}</option>`).join("");
    $(`axis-${end}`).value = chosenAxis;
  }
  $("driving").hidden = !maze;
  if (task.decision.kind === "normal" && !policy.valued) $("field").options[1].remove();
  document.querySelector(".growth").hidden = !data.curves.steps;
  $("trial").max = data.trial;
  $("growth-note").textContent = data.born.length
    ? "The line is the learning curve, the grey area the number of rules. The slider shows on the map which rules had been made by then; what they conclude is what they conclude today, and the field and the decision are those of all rules."
    : "The line is the learning curve, the grey area the number of rules. In which trial each rule was made is not known here, because rules were edited, merged or given from the start.";
}

function begin() {
  describe();
  connect();
  showOthers();
  look();
  layout();
  update({ list: true, editor: true });
  showTrial();
}

begin();
