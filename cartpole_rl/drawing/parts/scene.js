const element = (id) => document.getElementById(id);

function wrapped(angle) {
  return Math.atan2(Math.sin(angle), Math.cos(angle));
}

function prepared(canvas) {
  const ratio = window.devicePixelRatio || 1, { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Pixels per metre, and where the middle of the track is. */
function view(width, height, { track, pole }) {
  const scale = Math.min(width / (2 * (track + 0.12)), height / (2 * pole + 0.12));
  return { scale, middle: width / 2, rail: height / 2 };
}

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name);
}

function line(context, style, width, ...points) {
  context.strokeStyle = style;
  context.lineWidth = width;
  context.lineCap = "round";
  context.beginPath();
  points.forEach(([x, y]) => context.lineTo(x, y));
  context.stroke();
}

/** Draw a cart: m, rad, motor value; half the track and the pole, m; `ghost` is another cart behind it. */
function drawCart(canvas, { x, theta, motor, track, pole, failed = false, ghost = null }) {
  const { context, width, height } = prepared(canvas);
  const { scale, middle, rail } = view(width, height, { track, pole });
  const at = (metres) => middle + scale * metres;
  const tipOf = (x, theta) => [at(x) + scale * pole * Math.sin(theta), rail - scale * pole * Math.cos(theta)];
  line(context, colour("--line"), 4, [at(-track - 0.08), rail], [at(track + 0.08), rail]);
  for (const side of [-1, 1]) {
    line(context, colour(failed ? "--bad" : "--soft"), 3, [at(side * track), rail - 9], [at(side * track), rail + 9]);
  }
  const drawBody = (x, theta) => {
    context.fillStyle = colour("--cart");
    context.beginPath();
    context.roundRect(at(x) - 26, rail - 13, 52, 26, 6);
    context.fill();
    line(context, colour("--pole"), 7, [at(x), rail], tipOf(x, theta));
  };
  if (ghost) {
    context.globalAlpha = 0.3;
    drawBody(ghost.x, ghost.theta);
    context.globalAlpha = 1;
  }
  drawBody(x, theta);
  context.fillStyle = colour("--ink");
  context.beginPath();
  context.arc(at(x), rail, 3.5, 0, 2 * Math.PI);
  context.fill();
  line(context, colour("--cart"), 3, [at(x), rail + 24], [at(x) + motor * 0.25, rail + 24]);
  return { context, scale, at, rail, tip: tipOf(x, theta) };
}

/** Draw the angles of `points` over the last `span` of their time. */
function drawTrace(canvas, points, now, span) {
  const { context, width, height } = prepared(canvas);
  const level = (angle) => height / 2 - (angle / Math.PI) * (height / 2 - 8);
  const place = (point) => width * (1 - (now - point.time) / span);
  context.fillStyle = colour("--soft");
  context.font = "11px system-ui, sans-serif";
  line(context, colour("--line"), 1, [0, level(0)], [width, level(0)]);
  context.fillText("upright", 6, level(0) - 5);
  context.fillText("hanging", 6, height - 6);
  let drawn = [];
  points.forEach((point, number) => {
    if (number && Math.abs(point.angle - points[number - 1].angle) > Math.PI) {
      line(context, colour("--pole"), 2, ...drawn);
      drawn = [];
    }
    drawn.push([place(point), level(point.angle)]);
  });
  if (drawn.length) line(context, colour("--pole"), 2, ...drawn);
}
