"use strict";
// What the page knows: rules and their history, the pose, the decision there. update() shows it.

const $ = (id) => document.getElementById(id);
const data = JSON.parse($("data").textContent);
const { task, maze } = data;
const n = task.inputs.length;

// A rule is never changed, only replaced; so a list of rules is all that undo needs.
let rules = data.rules.map((row, k) => ({
  number: k + 1,
  centre: row.slice(0, n), width: row.slice(n, 2 * n), consequents: row.slice(2 * n),
  usage: data.usage[k] ?? 0, moment: data.moments[k] ?? 0, born: data.born[k] ?? 0,
}));
const first = rules, past = [], future = [];
let policy = makePolicy(task, rules), decision = null;
const votes = new WeakMap();  // of rules by themselves
let together = new Map();  // whether a rule is outvoted

const view = {
  pose: startPose(), a: 0, b: task.axes.length > 1 ? 1 : 0, field: "action", which: "listed",
  trial: data.trial, chosen: null, trail: [], chart: null, values: [0, 1],
  sort: ["usage", -1], all: false, pace: 0,  // ms that the last field took
};

function startPose() {
  if (maze) {
    const start = maze.starts[0] || task.robot.start;
    return [...start, ...(maze.told ? maze.goals[0] : [])];
  }
  return task.axes.map((_, i) => rangeOf(i)).map(([low, high]) => (low + high) / 2);
}

function chosen() {
  return rules.find((rule) => rule.number === view.chosen) || null;
}

function voteOf(rule) {
  if (!votes.has(rule)) votes.set(rule, alone(policy, rules.indexOf(rule)));
  return votes.get(rule);
}

// Whether all rules together choose something else at the centre of a rule, as in words.py.
function isOutvoted(rule) {
  if (task.decision.action_input || !task.choices.length) return false;
  if (!together.has(rule)) {
    const mine = voteOf(rule).choice;
    const theirs = mine === null ? null : decide(policy, rule.centre).choice;
    together.set(rule, mine !== null && mine !== theirs);
  }
  return together.get(rule);
}

// ------------------------------------------------------------------------------------ changes

// Take a list of rules in the place of the present one.
function put(list) {
  rules = list;
  together = new Map();
  policy = makePolicy(task, rules);
}

// Keep the present rules for undo, before something is changed.
function remember() {
  past.push(rules);
  if (past.length > 500) past.shift();
  future.length = 0;
}

function undo(from = past, to = future) {
  if (!from.length) return;
  to.push(rules);
  put(from.pop());
  update({ ground: true, list: true, editor: true });
}

// A number within the bounds of its column, with no more digits than single precision has.
function bounded(column, value) {
  const low = data.low[column], high = data.high[column];
  const inside = Math.min(Math.max(value, low), high), short = Number(inside.toPrecision(7));
  return Math.fround(short) >= low && Math.fround(short) <= high ? short : inside;
}

// Replace numbers of the chosen rule: [part, place, value] each.
function change(...changes) {
  const rule = chosen();
  if (!rule) return;
  const next = { ...rule, centre: [...rule.centre], width: [...rule.width], consequents: [...rule.consequents], edited: true };
  const begin = { centre: 0, width: n, consequents: 2 * n };
  for (const [part, i, value] of changes) {
    const period = part === "centre" && task.inputs[i].period;
    const plain = period ? value - period * Math.round(value / period) : value;
    if (Number.isFinite(plain)) next[part][i] = bounded(begin[part] + i, plain);
  }
  put(rules.map((old) => (old === rule ? next : old)));
}

function removeChosen() {
  if (!chosen()) return;
  if (rules.length <= data.counts[0]) {
    say(data.counts[0] === data.counts[1] ? "A fixed network keeps its rules." : "The last rule stays.");
    return;
  }
  remember();
  put(rules.filter((rule) => rule.number !== view.chosen));
  view.chosen = null;
  update({ ground: true, list: true, editor: true });
}

function copyHere() {
  const rule = chosen();
  if (!rule) return;
  if (rules.length >= data.counts[1]) {
    say("This network may have no more rules.");
    return;
  }
  remember();
  const number = 1 + Math.max(...first.map((r) => r.number), ...rules.map((r) => r.number));
  const centre = rule.centre.map((v, i) => bounded(i, view.pose[i] ?? v));
  put([...rules, { ...rule, number, centre, usage: 0, moment: 0, born: 0, edited: true }]);
  view.chosen = number;
  update({ ground: true, list: true, editor: true });
}

// The rules as a file that rules --load takes: numbers that were not touched keep their digits.
function ruleFile() {
  const rows = rules.map((rule, k) => {
    const { centre, width, consequents } = rule;
    return `    ${JSON.stringify({ rule: k + 1, centre, width, consequents })}`;
  });
  const head = JSON.stringify(data.head, null, 2).replace(/\n}$/, "");
  return `${head},\n  "rules": [\n${rows.join(",\n")}\n  ]\n}\n`;
}

function save() {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([ruleFile()], { type: "application/json" }));
  link.download = `${data.name}-rules.json`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  say(`Saved ${link.download}: python -m sofnn_torch.rules RUN --load ${link.download}`);
}

function say(words) {
  $("said").textContent = words;
}

// ------------------------------------------------------------------------------------- showing

let waiting = null;

// Decide at the pose; rules in the order of their shares.
function look() {
  decision = decide(policy, view.pose);
  const { shares } = decision, order = [...shares.keys()].filter((k) => shares[k] > 1e-4);
  decision.order = order.sort((p, q) => shares[q] - shares[p]);
}

// Show it with the next picture of the screen, however often something moves until then.
function soon(what) {
  if (waiting) {
    for (const [part, wanted] of Object.entries(what)) waiting[part] ||= wanted;
    return;
  }
  waiting = what;
  requestAnimationFrame(() => {
    const asked = waiting;
    waiting = null;
    update(asked);
  });
}

// Show what changed: the pose always; the ground, the list of rules, the editor where asked for.
function update({ ground = false, list = false, editor = false } = {}) {
  look();
  if (ground) drawGround();
  drawMap();
  showHere();
  if (editor) showEditor();
  if (list) showList();
  $("undo").disabled = !past.length;
  $("redo").disabled = !future.length;
}

// Lay the page out anew: after a change of its size or colours.
function layout() {
  inks.clear();
  const stage = document.querySelector(".stage"), h = mapHeight(stage.clientWidth);
  stage.style.height = $("ground").style.height = `${h}px`;
  update({ ground: true });
  drawCurve();
  showLegend();
}
