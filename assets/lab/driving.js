"use strict";
// What moves by itself: the robot that drives, and the growth of the rules over the trials.

let driving = null;

function drive() {
  if (arrived(maze, view.pose, maze.told ? view.pose.slice(3) : null)) toStart();
  driving = { steps: 0, left: 0, speeds: null, decisions: 0 };
  view.trail = [view.pose.slice(0, 2)];
  $("drive").textContent = "Stop";
  requestAnimationFrame(frame);
}

// One step of half a second; a new decision when the last was held long enough, or at a bump.
function oneStep() {
  const run = driving, goal = maze.told ? view.pose.slice(3) : null;
  if (run.left === 0) {
    decision = decide(policy, view.pose);
    run.speeds = wheels(task, decision);
    run.left = task.robot.hold;
    run.decisions += 1;
  }
  const chance = (m) => ($("noise").checked ? 1 + m * (2 * Math.random() - 1) : 1);
  const { pose, bumped } = roll(maze, task.robot, view.pose, run.speeds, [chance(maze.noise), chance(maze.noise / 2)]);
  view.pose.splice(0, 3, ...pose);
  view.trail.push(pose.slice(0, 2));
  run.steps += 1;
  run.left = bumped ? 0 : run.left - 1;
  run.bumps = (run.bumps || 0) + Number(bumped);
  if (arrived(maze, pose, goal)) return `goal after ${run.steps.toLocaleString("en")} steps`;
  return run.steps >= maze.most ? `no goal in ${run.steps.toLocaleString("en")} steps` : "";
}

function frame() {
  if (!driving) return;
  let end = "";
  for (let i = 0; i < Number($("speed").value) && !end; i++) end = oneStep();
  const { steps, decisions, bumps } = driving;
  $("odometer").textContent = `${end || `${steps.toLocaleString("en")} steps`}, ${decisions.toLocaleString("en")} decisions, ${bumps || 0} bumps`;
  update({ ground: $("field").value !== "none" && steps % 10 < Number($("speed").value) });
  showOthers();
  if (end) stop();
  else requestAnimationFrame(frame);
}

function stop() {
  if (!driving) return;
  driving = null;
  $("drive").textContent = "Drive";
  update({ ground: true, list: $("near").checked || view.sort[0] === "here" });
}

function toStart() {
  view.pose = startPose();
  view.trail = [];
  showOthers();
}

// -------------------------------------------------------------------------------------- growth

let playing = 0;

function toTrial(t) {
  view.trial = t;
  showTrial();
  drawCurve();
  update({ ground: true, list: true });
}

function play() {
  if (playing) return halt();
  if (view.trial >= data.trial) view.trial = 0;
  $("play").textContent = "Pause";
  const wait = Math.max(40, 8000 / Math.max(data.trial, 1));
  playing = setInterval(() => (view.trial < data.trial ? toTrial(view.trial + 1) : halt()), wait);
}

function halt() {
  clearInterval(playing);
  playing = 0;
  $("play").textContent = "Play";
}
