"use strict";
// The policy in plain numbers: the equations of sofnn_torch/export/runtime.py, parameters in the
// network's own precision, sums in double. K rules, n inputs, m outputs, J choices.

// What does not change while a state moves: parameters in rows, one rule after another.
function makePolicy(task, rules) {
  const single = task.precision === "float32" ? Math.fround : Number;
  const n = task.inputs.length, m = task.outputs.length, K = rules.length;
  const flat = (part, size) => {
    const out = new Float64Array(K * size);
    rules.forEach((rule, k) => rule[part].forEach((v, i) => { out[k * size + i] = single(v); }));
    return out;
  };
  return {
    task, n, m, K, rules,
    centres: flat("centre", n), widths: flat("width", n), consequents: flat("consequents", m),
    periods: task.inputs.map((axis) => single(axis.period)),
    acting: Boolean(task.decision.action_input),
    codes: task.decision.codes || [],
    valued: task.decision.kind === "normal" && task.outputs[m - 1] === "value",
  };
}

// An observation as the network takes it: at most at the ends of its axes.
function stateOf(policy, observation) {
  const { axes, clipped } = policy.task;
  return observation.map((v, i) => {
    const { low, high, period } = axes[i];
    if (clipped && !period) v = Math.min(Math.max(v, low ?? -Infinity), high ?? Infinity);
    return Math.fround(v);
  });
}

function wrapped(d, period) {
  return period ? d - period * Math.round(d / period) : d;
}

// Logarithm of one membership (eq. 1).
function logMembership(policy, k, i, v) {
  const at = k * policy.n + i;
  const d = wrapped(v - policy.centres[at], policy.periods[i]) / policy.widths[at];
  return -0.5 * d * d;
}

// Normalised firing (K) at inputs (n) of the network, and the strength of the strongest rule.
function firing(policy, inputs) {
  const { K, n } = policy, shares = new Float64Array(K);
  let most = -Infinity, sum = 0;
  for (let k = 0; k < K; k++) {
    let log = 0;
    for (let i = 0; i < n; i++) log += logMembership(policy, k, i, inputs[i]);
    shares[k] = log;
    if (log > most) most = log;
  }
  for (let k = 0; k < K; k++) sum += shares[k] = Math.exp(shares[k] - most);
  for (let k = 0; k < K; k++) shares[k] /= sum;
  return { shares, strongest: Math.exp(most) };
}

// Inputs of the network at a state: itself, or with each action where that is an antecedent.
function inputsAt(policy, x) {
  return policy.acting ? policy.codes.map((code) => [...x, code[0]]) : [x];
}

function weigh(policy, shares) {
  const { K, m, consequents } = policy, out = new Array(m).fill(0);
  for (let k = 0; k < K; k++) {
    const s = shares[k];
    if (s > 0) for (let j = 0; j < m; j++) out[j] += s * consequents[k * m + j];
  }
  return out;
}

// Value of choice j from consequents c (eq. 9), which begin at an offset.
function worth(policy, x, c, j, offset = 0) {
  const d = x.length, code = policy.codes[j];
  let sum = 0, coded = 0;
  for (let i = 0; i < d; i++) sum += c[offset + i] * x[i];
  for (let i = 0; i < code.length; i++) coded += c[offset + d + i] * code[i];
  return sum + coded + c[offset + policy.m - 1];
}

// What outputs of the network, one set or one for each choice, decide at a state.
function conclude(policy, x, outputs) {
  const { decision, discrete } = policy.task;
  if (decision.kind === "values") {
    const values = policy.codes.map((_, j) => worth(policy, x, outputs[policy.acting ? j : 0], j));
    let choice = 0;
    values.forEach((v, j) => { if (v > values[choice]) choice = j; });
    return { choice, values, value: values[choice], action: [decision.representatives[choice]] };
  }
  const [out] = outputs, m = decision.numbers;
  const value = policy.valued ? out[policy.m - 1] : null;
  if (!discrete) {
    const action = Array.from(out).slice(0, m).map((v) => Math.fround(Math.min(Math.max(v, -1), 1)));
    return { choice: null, values: null, value, action };
  }
  const choice = decision.edges.filter((edge) => edge < out[0]).length;
  return { choice, values: null, value, action: [out[0]] };
}

// The decision at an observation, without exploration and without the way out of loops.
function decide(policy, observation) {
  const x = stateOf(policy, observation);
  const sets = inputsAt(policy, x).map((inputs) => firing(policy, inputs));
  const outputs = sets.map(({ shares }) => weigh(policy, shares));
  const found = conclude(policy, x, outputs), { K } = policy;
  const shares = new Float64Array(K);
  for (const set of sets) for (let k = 0; k < K; k++) shares[k] += set.shares[k] / sets.length;
  const strongest = Math.max(...sets.map((set) => set.strongest));
  const decision = { ...found, x, sets, outputs, shares, strongest };
  return { ...decision, ...support(policy, decision) };
}

// How much each rule speaks for what is decided, against the next best choice. The sum over the
// rules is the margin: of mu from the nearest edge, or between the two best values.
function support(policy, { choice, values, x, sets, outputs }) {
  const { K, m, consequents } = policy, { edges } = policy.task.decision;
  const speaks = new Float64Array(K);
  const by = (edge, sign) => {
    const { shares } = sets[0];
    for (let k = 0; k < K; k++) speaks[k] = shares[k] * sign * (consequents[k * m] - edge);
  };
  if (choice === null) {
    by(0, outputs[0][0] < 0 ? -1 : 1);
    return { support: speaks, rival: null, margin: null };
  }
  if (!values) {
    const mu = outputs[0][0];
    if (!edges.length) return { support: speaks, rival: null, margin: null };
    const edge = edges.reduce((a, b) => (Math.abs(b - mu) < Math.abs(a - mu) ? b : a));
    const above = mu > edge, rival = choice + (above ? -1 : 1);
    by(edge, above ? 1 : -1);
    return { support: speaks, rival, margin: Math.abs(mu - edge), edge };
  }
  if (values.length < 2) return { support: speaks, rival: null, margin: null };
  let rival = choice ? 0 : 1;
  values.forEach((v, j) => { if (j !== choice && v > values[rival]) rival = j; });
  const [ours, theirs] = policy.acting ? [sets[choice], sets[rival]] : [sets[0], sets[0]];
  for (let k = 0; k < K; k++) {
    speaks[k] = ours.shares[k] * worth(policy, x, consequents, choice, k * m)
      - theirs.shares[k] * worth(policy, x, consequents, rival, k * m);
  }
  return { support: speaks, rival, margin: values[choice] - values[rival] };
}

// What one rule would do by itself at its centre: a choice, or null where it gives several the same
// value. Where the action is an antecedent, the choice that the rule is about.
function alone(policy, k) {
  const { m, n, consequents, centres, task, codes } = policy;
  const x = Array.from(centres.subarray(k * n, k * n + task.axes.length));
  const own = Array.from(consequents.subarray(k * m, k * m + m));
  if (policy.acting) {
    const far = codes.map(([code]) => Math.abs(code - centres[k * n + n - 1]));
    const choice = far.indexOf(Math.min(...far));
    return { choice, action: [codes[choice][0]], value: worth(policy, x, own, choice) };
  }
  const found = conclude(policy, x, [own]);
  const undecided = (found.values || []).filter((v) => v === found.value).length > 1;
  return undecided ? { ...found, choice: null, undecided } : found;
}

// An action as one number from -1 to 1 (in the maze right to left): what colours and ticks show.
function leaning(policy, { choice, action, undecided }) {
  const { command, discrete, actions } = policy.task;
  if (undecided) return 0;
  if (discrete) return actions.length < 2 ? 0 : (2 * choice) / (actions.length - 1) - 1;
  if (command.kind !== "wheels") return action[0];
  return Math.min(Math.max((action[1] - action[0]) / 0.8, -1), 1);  // a turn: +-4 of 10 mm/s
}
