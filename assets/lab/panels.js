"use strict";
// What stands beside and below the map: the decision, the chosen rule, all rules, the legend.

// A mark of an action that can be told apart without colour.
function swatch(s) {
  const colour = tint(s), straight = Math.abs(s) <= 1 / 3;
  const path = straight ? (maze ? "M8 12V2" : "M8 3V10") : s > 0 ? (maze ? "M8 12V6H2" : "M2 6H14L10 3") : (maze ? "M8 12V6H14" : "M14 6H2L6 3");
  return `<svg class="swatch" viewBox="0 0 16 13" aria-hidden="true"><path d="${path}" fill="none" stroke="${colour}" stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round"/></svg>`;
}

function escaped(what) {
  return String(what).replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);
}

// ---------------------------------------------------------------------------------------- here

function showHere() {
  const { shares, support } = decision;
  const order = decision.order.slice(0, 6);  // pictures first: they ask for sizes, texts change them
  drawScale();
  drawMemberships(order.slice(0, SERIES.length));
  const place = task.axes.map((axis, i) => `${axis.name} ${placeOn(axis, view.pose[i])}`).join(", ");
  $("place").textContent = place;
  $("action").innerHTML = swatch(leaning(policy, decision)) + escaped(actionName(task, decision));
  $("reason").textContent = reason(policy, decision);
  $("account").textContent = account(policy, decision);
  $("known").textContent = known(decision.strongest, task.theta);
  const most = Math.max(...order.map((k) => Math.abs(support[k])), 1e-12);
  $("voices").tBodies[0].innerHTML = order.map((k, row) => {
    const rule = rules[k], vote = voteOf(rule), far = support[k] / most;
    const [from, to] = far > 0 ? [35, 35 + 64 * far] : [35 + 34 * far, 35];
    const bar = `<i class="${far < 0 ? "no" : ""}" style="left:${from}%;width:${to - from}%"></i>`;
    const line = row < SERIES.length ? `<svg class="swatch" viewBox="0 0 16 13" aria-hidden="true"><path d="M0 6.5H16" stroke="${ink(SERIES[row])}" stroke-width="2" stroke-dasharray="${DASHES[row].join(" ")}"/></svg>` : "";
    const said = far < 0 ? "against" : "for";
    return `<tr data-rule="${rule.number}"${rule.number === view.chosen ? ' class="chosen"' : ""}>
      <td>${line}<button>${rule.number}</button></td><td>${percent(shares[k])}</td>
      <td>${swatch(leaning(policy, vote))}${escaped(actionName(task, vote))}</td>
      <td><div class="tug" title="${said} the decision by ${fixed(Math.abs(support[k]), 3)}">${bar}<span class="unseen">${said}</span></div></td></tr>`;
  }).join("");
  $("map").setAttribute("aria-label", `Map of the rules. At ${place}: ${reason(policy, decision)}`);
}

// -------------------------------------------------------------------------------------- editor

// The ends between which a number of a rule is dragged; more can be typed.
function reach(part, i) {
  if (part === "centre") return rangeOf(i);
  if (part === "width") {
    const [low, high] = rangeOf(i);
    return [data.low[n + i], Math.max((high - low) / 2, ...rules.map((r) => r.width[i]))];
  }
  const column = 2 * n + i, all = first.map((r) => r.consequents[i]);
  const [low, high] = [Math.min(...all), Math.max(...all)], pad = 0.25 * (high - low) || 1;
  const narrow = data.high[column] < 1e6;
  return narrow ? [data.low[column], data.high[column]] : [low - pad, high + pad];
}

function field(part, i, name, unit, scale) {
  const rule = chosen(), [low, high] = reach(part, i), value = rule[part][i];
  const step = Number(((high - low) * scale / 400).toPrecision(1)), key = `${part}-${i}`;
  const at = Number((value * scale).toPrecision(5));
  return `<label>${escaped(name)}<input type="range" data-key="${key}" aria-label="${escaped(name)}" min="${low * scale}" max="${high * scale}" step="any" value="${at}">
    <input type="number" data-key="${key}" aria-label="${escaped(name)} as a number" step="${step}" value="${at}"><small>${escaped(unit)}</small></label>`;
}

function showEditor() {
  const rule = chosen(), form = $("editor");
  form.hidden = $("rule-tools").hidden = !rule;
  if (!rule) {
    $("rule-title").textContent = "Rule";
    $("rule-born").textContent = "";
    $("sentence").textContent = "Click a rule on the map or in a table to read and change it.";
    return;
  }
  const vote = voteOf(rule), said = task.inputs.map((axis, i) => {
    const { unit } = shown(axis);
    return `${axis.name} is about ${aboutOn(axis, rule.centre[i], rule.width[i])}${isBearing(axis) || !unit ? "" : ` ${unit}`}`;
  });
  $("rule-title").textContent = `Rule ${rule.number}`;
  $("rule-born").textContent = [
    rule.edited ? "edited" : rule.born ? `made in trial ${rule.born}` : "",
    `${percent(rule.usage)} of the firing in the trial`, isOutvoted(rule) ? "outvoted at its centre" : "",
  ].filter(Boolean).join(" · ");
  const place = whereOf(rule);
  $("sentence").innerHTML = `<b>${escaped(place[0].toUpperCase() + place.slice(1))}.</b> If ${escaped(said.join(" and "))}, then ${swatch(leaning(policy, vote))}<b>${escaped(actionName(task, vote))}</b>.`;
  if (form.contains(document.activeElement) && form.dataset.rule === String(rule.number)) {
    for (const input of form.querySelectorAll("input")) {
      const [part, i] = input.dataset.key.split("-"), scale = part === "consequents" ? 1 : shown(task.inputs[i]).scale;
      if (input !== document.activeElement) input.value = Number((rule[part][i] * scale).toPrecision(5));
    }
    return;
  }
  form.dataset.rule = rule.number;
  const about = task.inputs.map((axis, i) => {
    const { scale, unit } = shown(axis);
    return field("centre", i, axis.name, unit, scale) + field("width", i, "± width", unit, scale);
  });
  const used = task.outputs.map((name, j) => [name, j]).filter(([, j]) => !isSilent(j));
  const then = used.map(([name, j]) => field("consequents", j, name, "", 1));
  form.innerHTML = `<fieldset><legend>If</legend>${about.join("")}</fieldset><fieldset><legend>Then</legend>${then.join("")}</fieldset>`;
}

// A consequent that is zero in every rule, as c_x of Q-learning by default.
function isSilent(j) {
  return task.decision.kind === "values" && first.every((rule) => rule.consequents[j] === 0);
}

// ----------------------------------------------------------------------------------- all rules

function sentence(rule) {
  const about = task.inputs.map((axis, i) => `${axis.name} ${aboutOn(axis, rule.centre[i], rule.width[i])}`);
  return `${whereOf(rule)} ${about.join(" ")} ${actionName(task, voteOf(rule))}`;
}

// Numbers (from 0) of the rules that the filters leave.
function listedRules() {
  const wanted = $("search").value.trim().split(/\s+/).filter(Boolean);
  const tests = wanted.map((word) => {
    if (/^\d+$/.test(word)) return (rule) => rule.number === Number(word);
    const at = new RegExp(`(^|[^\\p{L}])${word.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")}`, "iu");
    return (rule) => at.test(sentence(rule));
  });
  const vote = $("votes").value;
  return [...rules.keys()].filter((k) => {
    const rule = rules[k];
    return rule.born <= view.trial
      && (!vote || (voteOf(rule).undecided ? "undecided" : String(voteOf(rule).choice)) === vote)
      && (!$("fired").checked || rule.usage > 1e-4)
      && (!$("near").checked || decision.shares[k] > 0.001)
      && (!$("outvoted").checked || isOutvoted(rule))
      && tests.every((test) => test(rule));
  });
}

// Columns of the list: heading, what sorts, what is shown.
function columnsOf() {
  const columns = [
    ["number", "rule", (k) => rules[k].number, (k) => `<button>${rules[k].number}</button>`],
    ["usage", "used", (k) => rules[k].usage, (k) => percent(rules[k].usage)],
    ["moment", "at decision", (k) => rules[k].moment || Infinity, (k) => rules[k].moment || ""],
    ["here", "here", (k) => decision.shares[k], (k) => (decision.shares[k] < 0.0005 ? "" : percent(decision.shares[k]))],
  ];
  task.inputs.forEach((axis, i) => {
    const { unit } = shown(axis), name = axis.name + (unit && !isBearing(axis) ? ` [${unit}]` : "");
    columns.push([`in${i}`, `${i ? "and" : "if"} ${name}`, (k) => rules[k].centre[i], (k) => aboutOn(axis, rules[k].centre[i], rules[k].width[i])]);
  });
  columns.push(["vote", "then", (k) => leaning(policy, voteOf(rules[k])), (k) => {
    const vote = voteOf(rules[k]);
    return `${swatch(leaning(policy, vote))}${escaped(actionName(task, vote))}${isOutvoted(rules[k]) ? " <span title='outvoted: at its centre all rules together do something else'>*</span>" : ""}`;
  }]);
  if (task.decision.kind === "normal") {
    task.outputs.forEach((name, j) => columns.push([`out${j}`, name, (k) => rules[k].consequents[j], (k) => fixed(rules[k].consequents[j])]));
  } else columns.push(["value", "value", (k) => voteOf(rules[k]).value, (k) => fixed(voteOf(rules[k]).value)]);
  if (data.born.length) columns.push(["born", "made in trial", (k) => rules[k].born, (k) => rules[k].born || "by hand"]);
  return columns;
}

function showList() {
  const columns = columnsOf(), [key, way] = view.sort, by = columns.find((c) => c[0] === key)[2];
  const listed = listedRules().sort((p, q) => way * (by(p) - by(q)) || p - q);
  const cut = view.all ? listed : listed.slice(0, 100);
  $("rules").tHead.innerHTML = `<tr>${columns.map(([name, head]) => {
    const sorted = name === key ? ` aria-sort="${way > 0 ? "ascending" : "descending"}"` : "";
    return `<th scope="col"${sorted}><button data-sort="${name}">${escaped(head)}${name === key ? (way > 0 ? " ↑" : " ↓") : ""}</button></th>`;
  }).join("")}</tr>`;
  $("rules").tBodies[0].innerHTML = cut.map((k) => `<tr data-rule="${rules[k].number}"${rules[k].number === view.chosen ? ' class="chosen"' : ""}>${columns.map((c) => `<td>${c[3](k)}</td>`).join("")}</tr>`).join("");
  $("count").textContent = `${listed.length.toLocaleString("en")} of ${rules.length.toLocaleString("en")}`;
  $("more").hidden = cut.length === listed.length;
  $("more").textContent = `Show all ${listed.length.toLocaleString("en")}`;
}

// ----------------------------------------------------------------------------- legend and text

function showLegend() {
  const ends = task.discrete || task.decision.kind === "values" ? task.choices : null;
  const count = ends ? ends.length : 0, parts = [];
  if (view.field === "value") {
    parts.push(`<span>faint to full: value ${fixed(view.values[0])} to ${fixed(view.values[1])}</span>`);
  } else if (count && count <= 3) {
    ends.forEach((name, j) => parts.push(`<span>${swatch(count > 1 ? (2 * j) / (count - 1) - 1 : 0)}${escaped(name)}</span>`));
  } else {
    const names = maze ? ["right turn", "straight", "left turn"] : [`${task.actions[0]} low`, "middle", "high"];
    names.forEach((name, j) => parts.push(`<span>${swatch(j - 1)}${escaped(name)}</span>`));
  }
  const other = task.inputs.filter((_, i) => i !== view.a && i !== view.b && i < task.axes.length).map((axis) => axis.name);
  if (view.field !== "none" && other.length) parts.push(`<span>field at this ${escaped(listed(other))}</span>`);
  parts.push(`<span>dots: rules, larger the more they are used${other.length ? `, paler the further their ${escaped(listed(other))} from here` : ""}</span>`);
  parts.push("<span>rings: rules that decide here, broken if against</span>");
  $("legend").innerHTML = parts.join("");
}

function showTrial() {
  const { steps, reward, success, rules: counts } = data.curves, t = view.trial;
  const say = [`trial ${t} of ${data.trial}`];
  if (t > 0 && steps) {
    if (counts[t - 1] !== null) say.push(`${counts[t - 1].toLocaleString("en")} rules`);
    if (success) say.push(`${success[t - 1] ? "goal" : "no goal"} after ${steps[t - 1].toLocaleString("en")} steps`);
    else say.push(`return ${fixed(reward[t - 1])}`);
  }
  $("trial-text").textContent = say.join(" · ");
  $("trial").value = t;
}
