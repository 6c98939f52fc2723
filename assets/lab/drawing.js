"use strict";
// The map: field, walls and rules on the ground; the pose and the chosen rule above it.

// The field of the map for what the page shows now, with as little work as the changes need: a few
// changed rules are exchanged; where the state moved all are summed.
let drawn = null, refining = 0;
const SLOW = 10;  // ms of a sum, from which a coarse field stands in while something moves

function fieldNow(a, b, us, vs, wanted) {
  const kept = drawn && drawn.a === a && drawn.b === b && drawn.wanted === wanted && drawn.policy.K === policy.K
    && String([drawn.us, drawn.vs]) === String([us, vs]) && String(drawn.columns) === String(usedColumns(policy, wanted));
  const changed = kept ? [...rules.keys()].filter((k) => rules[k] !== drawn.policy.rules[k]) : [];
  const moved = hasMoved();
  if (!kept || changed.length > 5 || (changed.length && moved)) {
    drawn = makeField(policy, a, b, us, vs, wanted);
    sumField(drawn, view.pose);
  } else if (changed.length) swapRules(drawn, policy, changed);
  else if (moved) sumField(drawn, view.pose);
  return readField(drawn);
}

// Whether the inputs that the map does not show are others than those of its field.
function hasMoved() {
  return !drawn || view.pose.some((v, i) => i !== view.a && i !== view.b && v !== drawn.observation[i]);
}

function rgb(name) {
  return [1, 3, 5].map((i) => parseInt(ink(name).slice(i, i + 2), 16));
}

const tile = document.createElement("canvas");  // a pixel for each cell

function drawField(g, c, fine) {
  if (view.field === "none") return;
  const coarse = !fine && view.pace > SLOW && hasMoved();
  clearTimeout(refining);
  if (coarse) refining = setTimeout(() => drawGround(true), 150);
  const begun = performance.now(), cols = coarse ? 36 : 72, rows = Math.max(6, Math.round(cols * c.h / c.w));
  const us = Array.from({ length: cols }, (_, i) => c.x0 + (i + 0.5) * (c.x1 - c.x0) / cols);
  const vs = Array.from({ length: rows }, (_, i) => c.y0 + (i + 0.5) * (c.y1 - c.y0) / rows);
  const moves = hasMoved(), { leanings, values } = fieldNow(view.a, view.b, us, vs, view.field);
  if (moves && !coarse) view.pace = performance.now() - begun;
  let [low, high] = [Infinity, -Infinity];
  for (const v of values) { low = Math.min(low, v); high = Math.max(high, v); }
  view.values = [low, high];
  [tile.width, tile.height] = [cols, rows];
  const brush = tile.getContext("2d"), image = brush.createImageData(cols, rows);
  const [value, sides] = [rgb("value"), [rgb("right"), rgb("straight"), rgb("left")]];
  for (let cell = 0; cell < cols * rows; cell++) {
    const s = leanings[cell], side = s < -1 / 3 ? 0 : s > 1 / 3 ? 2 : 1;
    const dark = view.field === "value" ? 0.04 + 0.06 * Math.round(10 * (values[cell] - low) / (high - low || 1)) : side === 1 ? 0.03 : 0.2;
    const at = 4 * ((rows - 1 - Math.floor(cell / cols)) * cols + cell % cols);
    image.data.set(view.field === "value" ? value : sides[side], at);
    image.data[at + 3] = 255 * dark;
  }
  brush.putImageData(image, 0, 0);
  g.imageSmoothingEnabled = false;
  g.drawImage(tile, c.left, c.top, c.w, c.h);
  if (view.field === "action") drawHooks(g, c, us, vs, leanings);
}

// Hooks for what is done, every few cells; those of one side at once.
function drawHooks(g, c, us, vs, leanings) {
  const cols = us.length, every = Math.max(1, Math.round(cols / (c.w / 34))), heading = maze ? view.pose[2] : null;
  const paths = new Map();
  for (let j = every >> 1; j < vs.length; j += every) {
    for (let i = every >> 1; i < cols; i += every) {
      const s = leanings[j * cols + i], bent = Math.abs(s) > 1 / 3, key = tint(s);
      if (!paths.has(key)) paths.set(key, { path: new Path2D(), bent });
      hook(paths.get(key).path, c.px(us[i]), c.py(vs[j]), s, bent ? 10 : 6, heading);
    }
  }
  g.lineWidth = 1;
  for (const [colour, { path, bent }] of paths) {
    g.strokeStyle = colour;
    g.globalAlpha = bent ? 0.5 : 0.3;
    g.stroke(path);
  }
  g.globalAlpha = 1;
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

// All but the pose; the field as fine as it is worth a wait.
function drawGround(fine = false) {
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
