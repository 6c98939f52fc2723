"use strict";
// Small plots beside the map: where a decision lies, membership functions, the learning curve.

const DASHES = [[], [6, 3], [2, 3], [8, 3, 2, 3], [1, 4]];
const SERIES = ["right", "left", "goal", "accent", "ink"];

function text(g, what, x, y, align = "center", colour = "quiet", baseline = "middle") {
  g.fillStyle = ink(colour);
  g.textAlign = align;
  g.textBaseline = baseline;
  g.fillText(what, x, y);
}

// Values of the choices as bars, or numbers of the action on a line with the edges of choices.
function drawScale() {
  const canvas = $("scale"), { values, choice } = decision, { task: { choices, actions, decision: how } } = policy;
  const rows = values ? Math.min(values.length, 9) : 0;
  const high = `${values ? 20 * rows + 4 : 34 + 26 * (how.numbers - 1) + 8}px`;
  if (canvas.style.height !== high) canvas.style.height = high;
  const { g, w } = paper(canvas);
  if (values) {
    const order = [...values.keys()].sort((p, q) => values[q] - values[p]).slice(0, rows).sort((p, q) => p - q);
    const [low, top] = [Math.min(...values), Math.max(...values)], room = w - 190;
    order.forEach((j, row) => {
      const y = 10 + 20 * row, length = 4 + (room - 4) * (top > low ? (values[j] - low) / (top - low) : 1);
      text(g, choices[j], 110, y, "right", j === choice ? "ink" : "quiet");
      g.fillStyle = ink(j === choice ? "ink" : "quiet");
      g.globalAlpha = j === choice ? 1 : 0.45;
      g.fillRect(118, y - 5, length, 10);
      g.globalAlpha = 1;
      text(g, fixed(values[j], top - low < 0.1 ? 4 : 2), 124 + length, y, "left", j === choice ? "ink" : "quiet");
    });
    return;
  }
  const px = (v) => 12 + (w - 24) * (Math.min(Math.max(v, -1), 1) + 1) / 2;
  for (let j = 0; j < how.numbers; j++) {
    const y = 26 + 26 * j;
    g.strokeStyle = ink("quiet");
    g.lineWidth = 1;
    g.beginPath();
    g.moveTo(px(-1), y);
    g.lineTo(px(1), y);
    const edges = how.edges || [-1, 0, 1];
    for (const edge of edges) { g.moveTo(px(edge), y - 9); g.lineTo(px(edge), y + 5); }
    g.stroke();
    if (how.edges) {
      const ends = [-1, ...how.edges, 1];
      choices.forEach((name, i) => text(g, name, px((ends[i] + ends[i + 1]) / 2), y - 15, "center", i === choice ? "ink" : "quiet"));
    } else text(g, actions[j] || "", px(-1), y - 14, "left");
    const { shares } = decision.sets[0];
    for (let k = 0; k < policy.K; k++) {
      if (shares[k] < 0.01) continue;
      g.globalAlpha = 0.35;
      g.fillStyle = ink("quiet");
      circle(g, px(policy.consequents[k * policy.m + j]), y, 2 + 7 * Math.sqrt(shares[k]));
      g.fill();
    }
    g.globalAlpha = 1;
    const x = px(decision.outputs[0][j]);
    g.fillStyle = ink("ink");
    g.beginPath();
    g.moveTo(x, y - 2); g.lineTo(x - 5, y + 9); g.lineTo(x + 5, y + 9);
    g.fill();
  }
}

// Membership functions (eq. 1) of some rules on every input, and where the pose is.
function drawMemberships(ks) {
  const home = $("memberships");
  task.inputs.forEach((axis, i) => {
    if (!home.children[i]) {
      const canvas = document.createElement("canvas");
      canvas.setAttribute("role", "img");
      home.append(canvas);
    }
    const canvas = home.children[i], { g, w, h } = paper(canvas), [low, high] = rangeOf(i);
    canvas.setAttribute("aria-label", `Membership functions of rules ${ks.map((k) => rules[k].number).join(", ")} on ${axis.name}`);
    const [left, base, top] = [74, h - 16, 6], px = (v) => left + (w - left - 18) * (v - low) / (high - low);
    const { scale, unit } = shown(axis);
    text(g, axis.name, 0, (base + top) / 2 - 6, "left", "ink");
    if (unit) text(g, unit, 0, (base + top) / 2 + 9, "left");
    g.strokeStyle = ink("line");
    g.lineWidth = 1;
    g.beginPath();
    g.moveTo(left, base);
    g.lineTo(w - 18, base);
    g.stroke();
    const { at, step } = ticks(low * scale, high * scale, 5);
    for (const v of at) text(g, fixed(v, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))), px(v / scale), base + 9);
    const x = view.pose[i];
    if (x !== undefined) {
      g.strokeStyle = ink("ink");
      g.beginPath();
      g.moveTo(px(x), top - 4);
      g.lineTo(px(x), base);
      g.stroke();
    }
    ks.forEach((k, place) => {
      g.strokeStyle = ink(SERIES[place]);
      g.setLineDash(DASHES[place]);
      g.lineWidth = 1.6;
      g.beginPath();
      for (let p = left; p <= w - 18; p += 2) {
        const v = low + (high - low) * (p - left) / (w - left - 18);
        g.lineTo(p, base - (base - top) * Math.exp(logMembership(policy, k, i, v)));
      }
      g.stroke();
      g.setLineDash([]);
      if (x === undefined) return;
      g.fillStyle = ink(SERIES[place]);
      circle(g, px(x), base - (base - top) * Math.exp(logMembership(policy, k, i, x)), 2.6);
      g.fill();
    });
  });
}

// Steps or return of each trial, the number of rules, and the trial that is shown.
function drawCurve() {
  const { g, w, h } = paper($("curve")), { steps, reward, success, rules: counts } = data.curves;
  if (!steps) return;
  const line = success ? steps : reward, T = line.length;
  const [left, right, top, base] = [52, 52, 22, h - 18];
  const known = line.filter((v) => v !== null);
  let [low, high] = [Math.min(...known), Math.max(...known)];
  const log = success && low > 0, at = (v) => (log ? Math.log(v) : v);
  if (!(high > low)) { low -= 1; high += 1; }
  const px = (t) => left + (w - left - right) * (T > 1 ? (t - 1) / (T - 1) : 0.5);
  const py = (v) => base - (base - top) * (at(v) - at(low)) / (at(high) - at(low));
  const most = Math.max(...counts, 1);
  g.beginPath();
  g.moveTo(px(1), base);
  counts.forEach((v, t) => g.lineTo(px(t + 1), base - (base - top) * v / most));
  g.lineTo(px(T), base);
  g.fillStyle = ink("quiet");
  g.globalAlpha = 0.14;
  g.fill();
  g.globalAlpha = 1;
  g.strokeStyle = ink("ink");
  g.lineWidth = 1.4;
  g.beginPath();
  line.forEach((v, t) => { if (v !== null) g.lineTo(px(t + 1), py(v)); });
  g.stroke();
  if (success) {
    line.forEach((v, t) => {
      if (success[t]) return;
      g.strokeStyle = ink("against");
      circle(g, px(t + 1), py(v), 3);
      g.stroke();
    });
  }
  const marks = log ? [1, 2, 5].flatMap((f) => [1, 10, 100, 1e3, 1e4, 1e5].map((p) => f * p)) : ticks(low, high, 4).at;
  for (const v of marks) if (v >= low && v <= high) text(g, v.toLocaleString("en").replace("-", "−"), left - 6, py(v), "right");
  for (const t of ticks(1, T, 8).at) if (t >= 1) text(g, t, px(t), base + 10);
  text(g, most.toLocaleString("en"), w - right + 6, top, "left");
  text(g, "0", w - right + 6, base, "left");
  text(g, success ? "steps" : "return", left - 6, 7, "right", "ink");
  text(g, "rules", w - right + 6, 7, "left", "ink");
  const x = px(Math.max(1, view.trial));
  g.strokeStyle = ink("accent");
  g.lineWidth = 1.5;
  g.beginPath();
  g.moveTo(x, top - 6);
  g.lineTo(x, base);
  g.stroke();
}
