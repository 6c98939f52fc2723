"use strict";
// The policy on a grid over two inputs, the others as observed. It follows the mouse: at each cell
// stand the sum of the firing strengths and of these times consequents. A strength is a product of
// memberships, so each axis is computed once; a rule that changes is taken out and put in again.

const REACH = 1e-7;  // a strength below counts for nothing, unless there is no other
const FAINT = 1e-3;  // a sum below is made anew, of all rules

// Tables for a grid of values us of input a and vs of input b. Sums come with sumField.
function makeField(policy, a, b, us, vs, wanted = "action") {
  const { K, task } = policy, [cols, rows] = [us.length, vs.length];
  const seen = (i, values) => values.map((v) => {
    const { low, high, period } = task.axes[i];
    return Math.fround(task.clipped && !period ? Math.min(Math.max(v, low ?? -Infinity), high ?? Infinity) : v);
  });
  const field = {
    policy, a, b, us, vs, wanted, cols, rows, seenUs: seen(a, us), seenVs: seen(b, vs),
    columns: usedColumns(policy, wanted), across: new Float64Array(K * cols), up: new Float64Array(K * rows),
    from: new Int32Array(K), to: new Int32Array(K),  // columns that a rule reaches
    observation: null, rest: [], sums: [], totals: [], weights: new Float64Array(cols),
  };
  for (let k = 0; k < K; k++) tabulate(field, k);
  return field;
}

// Memberships of a rule on the two axes.
function tabulate(field, k) {
  const { policy, a, b, cols, rows, across, up, seenUs, seenVs } = field;
  let from = cols, to = 0;
  for (let i = 0; i < cols; i++) {
    across[k * cols + i] = Math.exp(logMembership(policy, k, a, seenUs[i]));
    if (across[k * cols + i] < REACH) continue;
    from = Math.min(from, i);
    to = i + 1;
  }
  for (let j = 0; j < rows; j++) up[k * rows + j] = Math.exp(logMembership(policy, k, b, seenVs[j]));
  [field.from[k], field.to[k]] = [from, to];
}

// What is left of a strength beside the two axes, for one set of inputs.
function restOf({ policy, a, b }, inputs, k) {
  let log = 0;
  for (let i = 0; i < policy.n; i++) if (i !== a && i !== b) log += logMembership(policy, k, i, inputs[i]);
  return Math.exp(log);
}

// Add a rule to the sums of a field, or take it out with a sign of -1.
function addRule(field, k, sign) {
  const { policy, cols, rows, across, up, rest, sums, totals, columns, weights } = field;
  for (let set = 0; set < sums.length; set++) {
    const sum = sums[set], own = rest[set][k];
    if (own < REACH) continue;
    for (let j = 0; j < rows; j++) {
      const strength = own * up[k * rows + j];
      if (strength < REACH) continue;
      const at = j * cols;
      let from = field.from[k], to = field.to[k];
      while (from < to && strength * across[k * cols + from] < REACH) from++;
      while (from < to && strength * across[k * cols + to - 1] < REACH) to--;
      for (let i = from; i < to; i++) {
        weights[i] = sign * strength * across[k * cols + i];
        sum[at + i] += weights[i];
      }
      for (let c = 0; c < columns.length; c++) {
        const total = totals[set][c], consequent = policy.consequents[k * policy.m + columns[c]];
        for (let i = from; i < to; i++) total[at + i] += weights[i] * consequent;
      }
    }
  }
}

// Sum all rules for an observation.
function sumField(field, observation) {
  const { policy, cols, rows, columns } = field, cells = cols * rows;
  field.observation = [...observation];
  const sets = inputsAt(policy, stateOf(policy, observation));
  field.rest = sets.map((inputs) => Float64Array.from({ length: policy.K }, (_, k) => restOf(field, inputs, k)));
  field.sums = sets.map(() => new Float64Array(cells));
  field.totals = sets.map(() => columns.map(() => new Float64Array(cells)));
  for (let k = 0; k < policy.K; k++) addRule(field, k, 1);
}

// Put other rules in the place of some: numbers ks of a policy of as many rules.
function swapRules(field, policy, ks) {
  for (const k of ks) addRule(field, k, -1);
  field.policy = policy;
  const sets = inputsAt(policy, stateOf(policy, field.observation));
  for (const k of ks) {
    tabulate(field, k);
    sets.forEach((inputs, set) => { field.rest[set][k] = restOf(field, inputs, k); });
    addRule(field, k, 1);
  }
}

// Leaning and value at each cell, in rows. Where hardly any rule fires, all of them count; far from
// every rule decide() adds in logarithms. Good to three digits, for drawing.
function readField(field) {
  const { policy, a, b, us, vs, seenUs, seenVs, cols, rows, sums, totals, columns } = field;
  const leanings = new Float32Array(cols * rows), values = new Float32Array(cols * rows);
  const outputs = sums.map(() => new Float64Array(policy.m)), x = stateOf(policy, field.observation);
  const at = [...field.observation];
  for (let j = 0; j < rows; j++) {
    x[b] = seenVs[j];
    at[b] = vs[j];
    for (let i = 0; i < cols; i++) {
      const cell = j * cols + i;
      x[a] = seenUs[i];
      at[a] = us[i];
      let lost = false;
      for (let set = 0; set < sums.length; set++) {
        const sum = sums[set][cell], out = outputs[set];
        if (sum >= FAINT) {
          for (let c = 0; c < columns.length; c++) out[columns[c]] = totals[set][c][cell] / sum;
        } else lost ||= !sumAll(field, set, i, j, out);
      }
      const found = lost ? decide(policy, at) : conclude(policy, x, outputs);
      leanings[cell] = leaning(policy, found);
      values[cell] = found.value ?? 0;
    }
  }
  return { leanings, values };
}

// Outputs at a cell from all rules; false where even that is next to nothing.
function sumAll({ policy, cols, rows, across, up, rest, columns }, set, i, j, out) {
  let sum = 0;
  out.fill(0);
  for (let k = 0; k < policy.K; k++) {
    const strength = rest[set][k] * across[k * cols + i] * up[k * rows + j];
    sum += strength;
    for (const c of columns) out[c] += strength * policy.consequents[k * policy.m + c];
  }
  for (const c of columns) out[c] /= sum;
  return sum > 1e-200;
}

// Columns of the consequents that a drawing needs: not those that are zero in every rule.
function usedColumns(policy, wanted) {
  const { m, K, consequents, task } = policy, normal = task.decision.kind === "normal";
  return Array.from({ length: m }, (_, j) => j).filter((j) => {
    if (normal) return wanted === "value" ? j === m - 1 : j < task.decision.numbers;
    for (let k = 0; k < K; k++) if (consequents[k * m + j] !== 0) return true;
    return false;
  });
}
