"use strict";
// Numbers and decisions in words; units and decimals as in sofnn_torch/rules/words.py.

const WINDS = ["E", "NE", "N", "NW", "W", "SW", "S", "SE"];

function isBearing(axis) {
  return axis.unit === "rad" && axis.period > 0;
}

// Factor and unit in which an axis is shown and typed.
function shown(axis) {
  if (isBearing(axis)) return { scale: 180 / Math.PI, unit: "°", digits: 0 };
  if (axis.unit === "m") return { scale: 1000, unit: "mm", digits: 0 };
  const span = axis.high !== null && axis.low !== null ? axis.high - axis.low : 1;
  return { scale: 1, unit: axis.unit, digits: Math.max(2, 2 - Math.floor(Math.log10(span))) };
}

function fixed(value, digits = 2) {
  const text = Math.abs(value) < 1e5 ? value.toFixed(digits) : value.toPrecision(3);
  return /^-0\.?0*$/.test(text) ? text.slice(1) : text.replace("-", "−");
}

function wind(angle) {
  const degrees = Math.round(turned(angle) * 180 / Math.PI);
  return WINDS[((Math.round(degrees / 45) % 8) + 8) % 8];
}

function numberOn(axis, value) {
  const { scale, digits } = shown(axis);
  return fixed(scale * (isBearing(axis) ? turned(value) : value), digits);
}

// A value with its unit, as in "150 mm" or "90° N".
function placeOn(axis, value) {
  const { unit } = shown(axis), text = numberOn(axis, value);
  if (isBearing(axis)) return `${text}° ${wind(value)}`;
  return unit ? `${text} ${unit}` : text;
}

// A membership function, as in "150 ± 60".
function aboutOn(axis, centre, width) {
  const { scale, digits } = shown(axis), text = `${numberOn(axis, centre)} ± ${fixed(scale * width, digits)}`;
  return isBearing(axis) ? `${text}° ${wind(centre)}` : text;
}

// What a rule is about on an axis, in the terms of terms.py: a term, "A to B", or nothing if all.
function termOf(terms, period, centre, width) {
  const { names, low, high } = terms, step = (high - low) / names.length;
  const away = names.map((_, j) => wrapped(low + step * (j + 0.5) - centre, period));
  const about = away.map((d) => Math.abs(d) <= Math.sqrt(2 * Math.log(2)) * width);
  if (about.every(Boolean)) return "";
  about[away.reduce((best, d, j) => (Math.abs(d) < Math.abs(away[best]) ? j : best), 0)] = true;
  const found = [...names.keys()].filter((j) => about[j]).sort((p, q) => away[p] - away[q]).map((j) => names[j]);
  return found.length === 1 ? found[0] : `${found[0]} to ${found.at(-1)}`;
}

// Where a rule is, in words.
function whereOf(rule) {
  const said = task.axes.map((axis, i) => termOf(data.terms[i], axis.period, rule.centre[i], rule.width[i]));
  const plane = data.maze ? [regionOf(said[0], said[1])] : [], rest = task.axes.map((axis, i) => said[i] && `${axis.name} ${said[i]}`);
  return [...plane, ...rest.slice(2 * plane.length)].filter(Boolean).join(", ") || "anywhere";
}

// Terms from west to east and from south to north as one phrase.
function regionOf(x, y) {
  if (!x || !y || `${x}${y}`.includes(" to ")) {
    const side = (term, line) => (term.includes(" to ") ? `from ${term}` : term === "middle" ? `in the middle ${line}` : term && `in the ${term}`);
    return [side(y, "row"), side(x, "column")].filter(Boolean).join(", ");
  }
  if (x === "middle" || y === "middle") {
    const other = y === "middle" ? x : y;
    return other === "middle" ? "in the middle" : `in the middle of the ${other}`;
  }
  const split = (term) => [term.slice(0, term.lastIndexOf(" ") + 1), term.slice(term.lastIndexOf(" ") + 1)];
  const [degree] = split(y), [same, east] = split(x);
  return degree === same ? `in the ${y}-${east}` : `in the ${y} and ${x}`;
}

function percent(share) {
  return share >= 0.0995 ? `${Math.round(100 * share)} %` : `${fixed(100 * share, 1)} %`;
}

// The name of what was decided.
function actionName(task, { choice, action, undecided }) {
  if (undecided) return "undecided";
  if (choice !== null) return task.choices[choice];
  return task.actions.map((name, j) => `${name} ${fixed(action[j])}`).join(", ");
}

function listed(names) {
  return names.length < 2 ? names.join("") : `${names.slice(0, -1).join(", ")} and ${names.at(-1)}`;
}

// The rules that speak most for a decision and most against it. Numbers of rules count from 1.
function voices(decision, most = 3, least = 0.03) {
  const { support } = decision, total = support.reduce((sum, v) => sum + Math.abs(v), 0) || 1;
  const loud = [...support.keys()].filter((k) => Math.abs(support[k]) > least * total);
  loud.sort((a, b) => Math.abs(support[b]) - Math.abs(support[a]));
  return {
    pro: loud.filter((k) => support[k] > 0).slice(0, most),
    contra: loud.filter((k) => support[k] < 0).slice(0, most),
  };
}

// Rules by their numbers, those of one mind together: "rules 12 and 40 (left turn)".
function minds(policy, ks) {
  const groups = new Map();
  for (const k of ks) {
    const name = policy.task.choices.length ? actionName(policy.task, alone(policy, k)) : "";
    groups.set(name, [...(groups.get(name) || []), policy.rules[k].number]);
  }
  return listed([...groups].map(([name, numbers]) => {
    const who = `rule${numbers.length > 1 ? "s" : ""} ${listed(numbers.map(String))}`;
    return name ? `${who} (${name})` : who;
  }));
}

// One sentence on why a decision is what it is.
function reason(policy, decision) {
  const { task } = policy, { pro, contra } = voices(decision), what = actionName(task, decision);
  let text = `${what[0].toUpperCase()}${what.slice(1)}`;
  if (decision.rival !== null) text += ` rather than ${task.choices[decision.rival]}`;
  const ours = pro.length ? minds(policy, pro) : "many small voices";
  if (contra.length) return `${text}: ${ours} outweigh${pro.length === 1 ? "s" : ""} ${minds(policy, contra)}.`;
  return `${text}: ${ours} say${pro.length === 1 ? "s" : ""} so, nobody much against.`;
}

// What the numbers behind a decision are, in a line.
function account(policy, decision) {
  const { task } = policy, { margin, outputs, values, choice, rival } = decision;
  if (values && rival !== null) {
    const [a, b] = [task.choices[choice], task.choices[rival]];
    return `Value of ${a} ${fixed(values[choice], 3)}, of ${b} ${fixed(values[rival], 3)}: ahead by ${fixed(margin, 3)}.`;
  }
  if (choice !== null && rival !== null) {
    return `mu is ${fixed(outputs[0][0])}; the edge to ${task.choices[rival]} is at ${fixed(decision.edge)}, ${fixed(margin)} away.`;
  }
  return task.outputs.map((name, j) => `${name} ${fixed(outputs[0][j])}`).join(", ");
}

// A short word on how well a place is known.
function known(strongest, theta) {
  if (strongest >= theta) return `Well known: the strongest rule fires by ${fixed(strongest)}.`;
  const text = strongest >= 0.005 ? fixed(strongest) : strongest.toExponential(0);
  return `Hardly known: the strongest rule fires by ${text} only, so this is a guess from rules far away.`;
}
