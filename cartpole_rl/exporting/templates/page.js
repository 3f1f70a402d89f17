const UPRIGHT = (5 / 180) * Math.PI; // rad
const STIFFNESS = 60; // N/m, of the reader's spring on the cart
const STRONGEST = 12; // N
const HISTORY = 10; // s
const PAUSE = 1.6; // s, after a failure
const simulated = new Cart();
let cart = simulated; // that is shown
let real = null; // the cart on the serial line, once one was connected
let before = cart.motion; // one period ago: the picture is drawn between the two
let pull = null; // the reader's: where it acts, "cart" or "pole", and the pointer in m
let keys = 0; // N, of the arrow keys
let time = 0, upright = 0, failedAt = null, wasUpright = false;
let history = [];

/** The force on the cart, N, and the angular acceleration of the pole, rad/s^2, that the reader exerts. */
function pushed() {
  let force = keys, turn = 0;
  if (pull) {
    const [x, , theta] = cart.motion;
    if (pull.on === "cart") force += STIFFNESS * (pull.x - x);
    else turn = 40 * Math.sin(Math.atan2(pull.x - x, pull.y) - theta);
  }
  return [Math.max(-STRONGEST, Math.min(STRONGEST, force)), turn];
}

function period() {
  if (failedAt !== null) {
    if (time - failedAt > PAUSE) restart();
    return;
  }
  before = cart.motion;
  cart.step((agentDrives() && cart.chosen()) || 0, ...pushed());
  record(DATA.period);
  if (cart.offTrack || cart.fallen) failedAt = time;
}

/** Note where the cart is, after a period of `dt` s. */
function record(dt) {
  const angle = wrapped(cart.motion[2]);
  upright = Math.abs(angle) < UPRIGHT ? upright + dt : 0;
  wasUpright = wasUpright || upright > 1;
  history.push({ time, angle });
  while (history.length && history[0].time < time - HISTORY) history.shift();
}

function restart() {
  if (real && !real.done) return; // its port is still open
  real = null;
  cart = simulated;
  cart.reset({ ...REST, theta: REST.theta + 0.02 * (Math.random() - 0.5), x: 0.1 * (Math.random() - 0.5) });
  forget();
}

/** Show the cart from now on. */
function forget() {
  before = cart.motion;
  failedAt = pull = null;
  upright = keys = 0;
  wasUpright = false;
}

function sizes() {
  return { track: cart.parameters.track_half_length, pole: 2 * cart.parameters.pole_com };
}

function agentDrives() {
  return element("agent").getAttribute("aria-pressed") === "true";
}

function verdict() {
  if (real && !real.driving) return [real.over === null ? "Not driving yet" : "Stopped", "--soft"];
  if (failedAt !== null) return [cart.fallen ? "Failed: the pole fell." : "Failed: the cart left its track.", "--bad"];
  if (!real && !agentDrives()) return ["The motor is off.", "--soft"];
  if (upright > 0.5) return [`Upright for ${upright.toFixed(1)} s`, "--good"];
  return wasUpright ? ["Recovering …", "--pole"] : [DATA.startsUpright ? "Balancing …" : "Swinging up …", "--soft"];
}

// pictures

function drawScene(share) {
  const [x, theta] = [0, 2].map((place) => before[place] + share * (cart.motion[place] - before[place]));
  const failed = failedAt !== null, motor = failed ? 0 : cart.motor;
  const { context, at, rail, scale, tip } = drawCart(element("scene"), { x, theta, motor, failed, ...sizes() });
  if (pull) {
    const from = pull.on === "cart" ? [at(x), rail] : tip;
    const to = pull.on === "cart" ? [at(pull.x), rail] : [at(pull.x), rail - scale * pull.y];
    line(context, colour("--push"), 3, from, to);
  } else if (keys) {
    line(context, colour("--push"), 4, [at(x), rail - 24], [at(x) + 8 * keys, rail - 24]);
  }
}

function drawStatus() {
  const [text, tone] = verdict();
  if (element("verdict").textContent !== text) element("verdict").textContent = text;
  element("verdict").style.color = `var(${tone})`;
  element("angle").textContent = `angle ${((wrapped(cart.motion[2]) * 180) / Math.PI).toFixed(0)}°`;
  element("motor").textContent = `motor value ${cart.motor}`;
}

let last = null, due = 0;
function frame(now) {
  const passed = last === null ? 0 : Math.min(0.1, (now - last) / 1000); // after a pause of the page, go on
  last = now;
  if (!real) due += passed;
  while (due >= DATA.period) {
    due -= DATA.period;
    time += DATA.period;
    period();
  }
  drawScene(real ? 1 : due / DATA.period);
  drawTrace(element("trace"), history, time, HISTORY);
  drawStatus();
  drawSerial();
  requestAnimationFrame(frame);
}

// the reader

function pointer(event) {
  const canvas = element("scene"), box = canvas.getBoundingClientRect();
  const { scale, middle, rail } = view(canvas.clientWidth, canvas.clientHeight, sizes());
  return { x: (event.clientX - box.left - middle) / scale, y: (rail - (event.clientY - box.top)) / scale };
}

element("scene").addEventListener("pointerdown", (event) => {
  if (real) return;
  const { x, y } = pointer(event), [cartX, , theta] = cart.motion, length = 2 * cart.parameters.pole_com;
  const toTip = Math.hypot(x - cartX - length * Math.sin(theta), y - length * Math.cos(theta));
  pull = { on: toTip < 0.4 * length ? "pole" : "cart", x, y };
  element("scene").setPointerCapture(event.pointerId);
});
element("scene").addEventListener("pointermove", (event) => {
  if (pull) Object.assign(pull, pointer(event));
});
for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
  element("scene").addEventListener(end, () => (pull = null));
}
const ARROWS = { ArrowLeft: -8, ArrowRight: 8 };
window.addEventListener("keydown", (event) => {
  if (!real && event.key in ARROWS && event.target.type !== "range") {
    keys = ARROWS[event.key];
    event.preventDefault();
  }
});
window.addEventListener("keyup", (event) => {
  if (event.key in ARROWS) keys = 0;
});
window.addEventListener("blur", () => (keys = 0)); // the release goes to another window

function apply() {
  const friction = Number(element("friction").value), pole = DATA.poles[element("pole").value];
  for (const name of ["cart_coulomb", "cart_viscous"]) simulated.parameters[name] = friction * DATA.cart[name];
  simulated.parameters.latency = element("latency").value / 1000;
  Object.assign(simulated.parameters, pole);
  element("friction-value").textContent = `${friction.toFixed(1)} × nominal`;
  element("latency-value").textContent = `${Number(Number(element("latency").value).toFixed(1))} ms`;
  element("pole-value").textContent = `${(200 * pole.pole_com).toFixed(0)} cm`;
}

function nominal() {
  element("friction").value = 1;
  element("latency").value = 1000 * DATA.cart.latency;
  element("pole").value = DATA.trained;
  apply();
}

element("latency").max = 1000 * DATA.longestLatency; // its step is "any": no latency is rounded
element("pole").max = DATA.poles.length - 1;
for (const id of ["friction", "latency", "pole"]) element(id).addEventListener("input", apply);
element("nominal").addEventListener("click", nominal);
element("restart").addEventListener("click", restart);
element("agent").addEventListener("click", () => {
  element("agent").setAttribute("aria-pressed", String(!agentDrives()));
});
nominal();
restart();
requestAnimationFrame(frame);
