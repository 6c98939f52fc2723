"use strict";
// A robot on two wheels in the plane: kinematics, as dead reckoning has it. Wheels roll without
// slip; at a wall the robot slides along it. Lengths in metres, angles in radians.

// Speeds of the left and right wheel [m/s] for an action, as runtime.py commands them.
function wheels(task, { choice, action }) {
  const { command } = task;
  if (command.kind === "wheels") return action.map((v) => v * command.forward);
  const steer = task.discrete ? choice - 1 : action[0];
  const forward = command.forward * (1 - Math.abs(steer)), turn = command.turn * steer;
  return [forward - turn, forward + turn];
}

function turned(angle) {
  return angle - 2 * Math.PI * Math.floor((angle + Math.PI) / (2 * Math.PI));
}

// Free distance between the rim of a robot and the nearest wall.
function clearance(maze, x, y) {
  let least = Infinity;
  for (const [x0, y0, x1, y1] of maze.walls) {
    const d = Math.hypot(Math.max(x0 - x, 0, x - x1), Math.max(y0 - y, 0, y - y1));
    if (d < least) least = d;
  }
  return least - maze.radius;
}

// One step of the simulator's length. Noise is a factor of the way and one of the turn.
function roll(maze, robot, pose, [left, right], noise = [1, 1]) {
  const [x, y, heading] = pose;
  const way = (left + right) / 2 * robot.seconds * noise[0];
  const turn = (right - left) / robot.wheel_base * robot.seconds * noise[1];
  const dx = way * Math.cos(heading + turn / 2), dy = way * Math.sin(heading + turn / 2);
  const after = turned(heading + turn);
  if (clearance(maze, x + dx, y + dy) >= 0) return { pose: [x + dx, y + dy, after], bumped: false };
  for (const [a, b] of [[dx, 0], [0, dy]]) {
    if (clearance(maze, x + a, y + b) >= 0) return { pose: [x + a, y + b, after], bumped: true };
  }
  return { pose: [x, y, after], bumped: true };
}

function arrived(maze, pose, goal) {
  const goals = goal ? [goal] : maze.goals;
  return goals.some(([x, y]) => Math.hypot(pose[0] - x, pose[1] - y) <= maze.goal_radius);
}
