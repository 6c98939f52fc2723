"use strict";
// The map: field, walls and rules on the ground; the pose and the chosen rule above it.

const inks = new Map();  // colours of the style, by name; cleared when light becomes dark

function ink(name) {
  if (!inks.has(name)) {
    inks.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  }
  return inks.get(name);
}

// A canvas cleared and scaled to the pixels of the screen.
function paper(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
  }
  const g = canvas.getContext("2d");
  g.setTransform(ratio, 0, 0, ratio, 0, 0);
  g.clearRect(0, 0, w, h);
  g.lineCap = g.lineJoin = "round";
  g.font = "12px system-ui, 'DejaVu Sans', sans-serif";
  return { g, w, h };
}

// Colour of a leaning from -1 to 1.
function tint(s) {
  return ink(s < -1 / 3 ? "right" : s > 1 / 3 ? "left" : "straight");
}

// The range of an input that is worth a look, and of two of them as a map.
const ranges = [];

function rangeOf(i) {
  if (!ranges[i]) {
    const axis = task.inputs[i], ends = (way) => first.map((r) => r.centre[i] + way * 2 * r.width[i]);
    ranges[i] = [axis.low ?? Math.min(...ends(-1)), axis.high ?? Math.max(...ends(1))];
  }
  return ranges[i];
}

function chartOf(w, h) {
  const [left, right, top, bottom] = [maze ? 42 : 56, maze ? 12 : 20, 8, 36];
  let [[x0, x1], [y0, y1]] = [rangeOf(view.a), rangeOf(view.b)];
  if (maze) {
    x0 = Math.min(...maze.walls.map((b) => b[0]));
    x1 = Math.max(...maze.walls.map((b) => b[2]));
    y0 = Math.min(...maze.walls.map((b) => b[1]));
    y1 = Math.max(...maze.walls.map((b) => b[3]));
  }
  let [sx, sy] = [(w - left - right) / (x1 - x0), (h - top - bottom) / (y1 - y0)];
  if (maze) sx = sy = Math.min(sx, sy);
  return {
    x0, x1, y0, y1, sx, sy, w: (x1 - x0) * sx, h: (y1 - y0) * sy, left, top,
    px: (x) => left + (x - x0) * sx, py: (y) => top + (y1 - y) * sy,
    x: (px) => x0 + (px - left) / sx, y: (py) => y1 - (py - top) / sy,
  };
}

// Height of the map for its width.
function mapHeight(w) {
  if (!maze) return Math.round(Math.min(0.8 * w, 620));
  const c = chartOf(w, 1e6);
  return Math.min(c.h + 44, 760);
}

function ticks(low, high, most = 6) {
  const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((f) => f * power >= rough);
  const out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(v);
  return { step, at: out };
}

function drawAxes(g, c) {
  g.fillStyle = ink("quiet");
  g.strokeStyle = ink("line");
  g.lineWidth = 1;
  for (const [i, horizontal] of [[view.a, true], [view.b, false]]) {
    const { scale, unit } = shown(task.inputs[i]), [low, high] = horizontal ? [c.x0, c.x1] : [c.y0, c.y1];
    const { at, step } = ticks(low * scale, high * scale);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
    g.textAlign = horizontal ? "center" : "right";
    g.textBaseline = horizontal ? "top" : "middle";
    for (const v of at) {
      const text = fixed(v, digits);
      if (horizontal) g.fillText(text, c.px(v / scale), c.top + c.h + 5);
      else g.fillText(text, c.left - 6, c.py(v / scale));
    }
    const name = task.inputs[i].name + (unit ? ` [${unit}]` : "");
    g.save();
    if (horizontal) g.translate(c.left + c.w / 2, c.top + c.h + 21);
    else { g.translate(2, c.top + c.h / 2); g.rotate(-Math.PI / 2); g.textBaseline = "top"; g.textAlign = "center"; }
    g.fillText(name, 0, horizontal ? 0 : -1);
    g.restore();
  }
  g.strokeRect(c.left, c.top, c.w, c.h);
}

// Add to a path a tick that leads on, or bends to a side: by a leaning, from a heading or, where
// that is null, across a chart.
function hook(path, x, y, s, length, heading) {
  const bent = Math.abs(s) > 1 / 3;
  if (heading === null) {
    const half = bent ? (Math.sign(s) * length) / 2 : 0;
    path.moveTo(x - half, y + (bent ? 0 : length / 3));
    path.lineTo(x + half, y - (bent ? 0 : length / 3));
    if (bent) path.lineTo(x + half - Math.sign(s) * length / 4, y - length / 4);
    return;
  }
  const [ux, uy] = [Math.cos(heading), -Math.sin(heading)], far = length * (bent ? 0.6 : 1);
  path.moveTo(x, y);
  path.lineTo(x + ux * far, y + uy * far);
  const aside = Math.sign(s) * length * 0.55;
  if (bent) path.lineTo(x + ux * far + uy * aside, y + uy * far - ux * aside);
}

// Add a triangle that points to a side, or a dot: by a leaning.
function mark(path, x, y, s, r) {
  const way = Math.sign(s) * r;
  if (Math.abs(s) <= 1 / 3) {
    path.moveTo(x + 0.8 * r, y);
    path.arc(x, y, 0.8 * r, 0, 2 * Math.PI);
    return;
  }
  path.moveTo(x + 1.3 * way, y);
  path.lineTo(x - way, y - r);
  path.lineTo(x - way, y + r);
  path.closePath();
}

// Draw one hook.
function tick(g, ...where) {
  g.beginPath();
  hook(g, ...where);
  g.stroke();
}

function drawField(g, c, fine) {
  if (view.field === "none") return;
  const columns = fine ? 72 : view.coarse, rows = Math.max(6, Math.round(columns * c.h / c.w));
  const us = Array.from({ length: columns }, (_, i) => c.x0 + (i + 0.5) * (c.x1 - c.x0) / columns);
  const vs = Array.from({ length: rows }, (_, i) => c.y0 + (i + 0.5) * (c.y1 - c.y0) / rows);
  const { leanings, values } = fieldOf(policy, view.pose, view.a, view.b, us, vs, view.field);
  const [cw, ch] = [c.w / columns, c.h / rows];
  let [low, high] = [Infinity, -Infinity];
  for (const v of values) { low = Math.min(low, v); high = Math.max(high, v); }
  view.values = [low, high];
  for (let j = 0; j < rows; j++) {
    for (let i = 0; i < columns; i++) {
      const s = leanings[j * columns + i], v = (values[j * columns + i] - low) / (high - low || 1);
      if (view.field === "value") {
        g.fillStyle = ink("value");
        g.globalAlpha = 0.04 + 0.6 * Math.round(v * 10) / 10;
      } else {
        g.fillStyle = tint(s);
        g.globalAlpha = Math.abs(s) < 1 / 3 ? 0.03 : 0.2;
      }
      const [x, y] = [Math.round(c.left + i * cw), Math.round(c.top + c.h - (j + 1) * ch)];
      g.fillRect(x, y, Math.round(c.left + (i + 1) * cw) - x, Math.round(c.top + c.h - j * ch) - y);
    }
  }
  const every = Math.max(1, Math.round(columns / (c.w / 34))), heading = maze ? view.pose[2] : null;
  g.lineWidth = 1;
  if (view.field === "action") {
    for (let j = every >> 1; j < rows; j += every) {
      for (let i = every >> 1; i < columns; i += every) {
        const s = leanings[j * columns + i];
        g.strokeStyle = tint(s);
        g.globalAlpha = Math.abs(s) > 1 / 3 ? 0.5 : 0.3;
        tick(g, c.px(us[i]), c.py(vs[j]), s, Math.abs(s) > 1 / 3 ? 10 : 6, heading);
      }
    }
  }
  g.globalAlpha = 1;
}

function circle(g, x, y, r) {
  g.beginPath();
  g.arc(x, y, r, 0, 2 * Math.PI);
}

function drawMaze(g, c) {
  const spot = ([x, y], r, colour, dash, text) => {
    g.setLineDash(dash);
    g.strokeStyle = g.fillStyle = ink(colour);
    circle(g, c.px(x), c.py(y), r * c.sx);
    g.globalAlpha = 0.1;
    g.fill();
    g.globalAlpha = 1;
    g.stroke();
    g.setLineDash([]);
    g.textAlign = "center";
    g.textBaseline = "bottom";
    g.fillText(text, c.px(x), c.py(y) - r * c.sx - 3);
  };
  g.lineWidth = 1.3;
  maze.subgoals.forEach((at, i) => spot(at, maze.subgoal_radius, "quiet", [2, 4], `sub-goal ${i + 1}`));
  maze.starts.forEach((at) => spot(at, maze.start_radius || maze.radius, "quiet", [], "start"));
  maze.goals.forEach((at) => spot(at, maze.goal_radius, "goal", [], "goal"));
  g.fillStyle = ink("wall");
  for (const [x0, y0, x1, y1] of maze.walls) {
    g.fillRect(c.px(x0), c.py(y1), (x1 - x0) * c.sx, (y1 - y0) * c.sy);
  }
}

// How much a rule is about the inputs that the map does not show.
function aboutUnseen(k) {
  let log = 0;
  for (let i = 0; i < policy.n; i++) {
    const value = view.pose[i];
    if (i !== view.a && i !== view.b && value !== undefined) log += logMembership(policy, k, i, value);
  }
  return Math.exp(log);
}

// Rules of one colour and paleness are drawn at once.
function drawRules(g, c, listed) {
  const most = Math.max(...rules.map((r) => r.usage || 0), 1e-9), groups = new Map(), fresh = new Path2D();
  for (const k of listed) {
    const rule = rules[k], s = leaning(policy, voteOf(rule)), near = Math.round(5 * aboutUnseen(k)) / 5;
    const [x, y] = [c.px(rule.centre[view.a]), c.py(rule.centre[view.b])], key = `${tint(s)} ${near}`;
    const r = 1.6 + 3 * Math.sqrt((rule.usage || 0) / most);
    if (!groups.has(key)) groups.set(key, { colour: tint(s), near, dots: new Path2D(), hooks: new Path2D() });
    const { dots, hooks } = groups.get(key);
    if (maze) {
      dots.moveTo(x + r, y);
      dots.arc(x, y, r, 0, 2 * Math.PI);
      hook(hooks, x, y, s, 13, rule.centre[2]);
    } else mark(dots, x, y, s, r + 2);
    if (rule.born === view.trial && view.trial < data.trial) {
      fresh.moveTo(x + 8, y);
      fresh.arc(x, y, 8, 0, 2 * Math.PI);
    }
  }
  g.lineWidth = 1.4;
  for (const { colour, near, dots, hooks } of [...groups.values()].sort((p, q) => p.near - q.near)) {
    g.globalAlpha = 0.14 + 0.86 * near;
    g.strokeStyle = g.fillStyle = colour;
    g.fill(dots);
    g.stroke(hooks);
  }
  g.globalAlpha = 1;
  g.strokeStyle = ink("accent");
  g.stroke(fresh);
}

// All but the pose. A fine field takes longer; while something is dragged a coarse one is enough.
function drawGround(fine) {
  const { g, w, h } = paper($("ground")), c = chartOf(w, h);
  view.chart = c;
  g.save();
  g.beginPath();
  g.rect(c.left, c.top, c.w, c.h);
  g.clip();
  g.fillStyle = ink("floor");
  g.fillRect(c.left, c.top, c.w, c.h);
  drawField(g, c, fine);
  if (maze) drawMaze(g, c);
  if (view.which === "listed") drawRules(g, c, listedRules());
  g.restore();
  drawAxes(g, c);
}

function ellipse(g, c, rule, times) {
  g.beginPath();
  const [rx, ry] = [rule.width[view.a] * c.sx, rule.width[view.b] * c.sy];
  g.ellipse(c.px(rule.centre[view.a]), c.py(rule.centre[view.b]), times * rx, times * ry, 0, 0, 7);
  g.stroke();
}

// Where a chosen rule can be taken hold of: pixels by name.
function handles(rule) {
  const c = view.chart, [x, y] = [c.px(rule.centre[view.a]), c.py(rule.centre[view.b])];
  const found = {
    centre: [x, y],
    across: [x + rule.width[view.a] * c.sx, y],
    up: [x, y - rule.width[view.b] * c.sy],
  };
  if (maze) {
    const far = 46, heading = rule.centre[2];
    found.heading = [x + far * Math.cos(heading), y - far * Math.sin(heading)];
  }
  return found;
}

function drawChosen(g, c, rule) {
  const at = handles(rule), [x, y] = at.centre;
  g.strokeStyle = g.fillStyle = ink("accent");
  g.lineWidth = 1.6;
  ellipse(g, c, rule, 1);
  g.setLineDash([3, 4]);
  ellipse(g, c, rule, 2);
  g.setLineDash([]);
  if (maze) {
    const [heading, width] = [rule.centre[2], Math.min(rule.width[2], Math.PI)];
    g.globalAlpha = 0.14;
    g.beginPath();
    g.moveTo(x, y);
    g.arc(x, y, 46, -heading - width, -heading + width);
    g.fill();
    g.globalAlpha = 1;
    g.beginPath();
    g.moveTo(x, y);
    g.lineTo(...at.heading);
    g.stroke();
  }
  for (const [name, [hx, hy]] of Object.entries(at)) {
    g.fillStyle = name === "centre" ? ink("accent") : ink("card");
    circle(g, hx, hy, name === "centre" ? 5 : 4.5);
    g.fill();
    g.stroke();
  }
}

// Rings around the rules that decide here: whole for the decision, broken against it.
function drawVoices(g, c) {
  const { shares, support } = decision;
  decision.order.filter((k) => shares[k] > 0.01).slice(0, 12).forEach((k, place) => {
    const rule = rules[k], [x, y] = [c.px(rule.centre[view.a]), c.py(rule.centre[view.b])];
    const against = support[k] < 0, r = 4 + 16 * Math.sqrt(shares[k]);
    g.lineWidth = 1.6;
    g.setLineDash(against ? [3, 3] : []);
    g.strokeStyle = ink(against ? "against" : "ink");
    circle(g, x, y, r);
    g.stroke();
    g.setLineDash([]);
    if (view.which === "here") {
      const s = leaning(policy, voteOf(rule));
      g.strokeStyle = g.fillStyle = tint(s);
      if (maze) tick(g, x, y, s, 13, rule.centre[2]);
      else {
        g.beginPath();
        mark(g, x, y, s, 5);
        g.fill();
      }
    }
    if (place < 4) {
      g.textAlign = "left";
      g.textBaseline = "bottom";
      g.lineWidth = 3;
      g.strokeStyle = ink("floor");
      g.strokeText(rule.number, x + r * 0.7, y - r * 0.7);
      g.fillStyle = ink("ink");
      g.fillText(rule.number, x + r * 0.7, y - r * 0.7);
    }
  });
}

function drawRobot(g, c) {
  const [x, y] = [c.px(view.pose[view.a]), c.py(view.pose[view.b])];
  g.strokeStyle = ink("robot");
  g.fillStyle = ink("floor");
  g.lineWidth = 2;
  if (!maze) {
    g.beginPath();
    g.moveTo(x - 14, y); g.lineTo(x - 5, y); g.moveTo(x + 5, y); g.lineTo(x + 14, y);
    g.moveTo(x, y - 14); g.lineTo(x, y - 5); g.moveTo(x, y + 5); g.lineTo(x, y + 14);
    g.stroke();
    return;
  }
  const r = maze.radius * c.sx, heading = view.pose[2], [nx, ny] = nose();
  circle(g, x, y, r);
  g.globalAlpha = 0.85;
  g.fill();
  g.globalAlpha = 1;
  g.stroke();
  g.strokeStyle = tint(leaning(policy, decision));
  g.lineWidth = 3;
  tick(g, x + r * Math.cos(heading), y - r * Math.sin(heading), leaning(policy, decision), 18, heading);
  g.lineWidth = 2;
  g.strokeStyle = ink("robot");
  g.beginPath();
  g.moveTo(x, y);
  g.lineTo(x + r * Math.cos(heading), y - r * Math.sin(heading));
  g.stroke();
  g.fillStyle = ink("floor");
  circle(g, nx, ny, 4.5);
  g.fill();
  g.stroke();
}

// The handle by which the robot is turned.
function nose() {
  const c = view.chart, r = maze.radius * c.sx + 26, [x, y, heading] = view.pose;
  return [c.px(x) + r * Math.cos(heading), c.py(y) - r * Math.sin(heading)];
}

function drawMap() {
  const { g } = paper($("map")), c = view.chart;
  if (view.trail.length > 1) {
    g.strokeStyle = ink("accent");
    g.globalAlpha = 0.7;
    g.lineWidth = 2;
    g.beginPath();
    view.trail.forEach(([x, y]) => g.lineTo(c.px(x), c.py(y)));
    g.stroke();
    g.globalAlpha = 1;
  }
  if (view.which !== "none") drawVoices(g, c);
  if (chosen()) drawChosen(g, c, chosen());
  drawRobot(g, c);
}
