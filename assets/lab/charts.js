"use strict";
// What all drawings share: colours, paper, axes, and the marks of actions.

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

function circle(g, x, y, r) {
  g.beginPath();
  g.arc(x, y, r, 0, 2 * Math.PI);
}
