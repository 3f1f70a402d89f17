const DATA = @@data@@;

function decoded(text) {
  if (text === null) return null;
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return Float64Array.from(new Float32Array(bytes.buffer));
}

const NO_NOISE = [0, 0, 0];
const REST = { x: 0, x_dot: 0, theta: DATA.startsUpright ? 0 : Math.PI, theta_dot: 0 };
const LAYERS = DATA.layers.map((layer) => {
  const decodedLayer = {};
  for (const [name, text] of Object.entries(layer)) decodedLayer[name] = decoded(text);
  return decodedLayer;
});

function normalized(units, layer) {
  const size = units.length / DATA.groups;
  for (let start = 0; start < units.length; start += size) {
    const part = units.subarray(start, start + size);
    const mean = part.reduce((sum, unit) => sum + unit, 0) / size;
    const variance = part.reduce((sum, unit) => sum + (unit - mean) ** 2, 0) / size;
    const scale = 1 / Math.sqrt(variance + DATA.epsilon);
    for (let i = 0; i < size; i++) {
      part[i] = layer.gain[start + i] * (part[i] - mean) * scale + layer.shift[start + i];
    }
  }
}

/** The action values of an observation. */
function actionValues(observation) {
  let input = observation;
  LAYERS.forEach((layer, number) => {
    const output = Float64Array.from(layer.bias);
    for (let row = 0, place = 0; row < output.length; row++) {
      for (let column = 0; column < input.length; column++) output[row] += layer.weight[place++] * input[column];
    }
    if (layer.gain) normalized(output, layer);
    input = number < LAYERS.length - 1 ? output.map((unit) => Math.max(unit, 0)) : output;
  });
  return input;
}

/** A simulated cart with its agent. `parameters` may be changed at any time. */
class Cart {
  constructor(parameters = {}) {
    this.parameters = { ...DATA.cart, ...parameters };
    this.reset(REST);
  }

  get table() {
    return DATA.names.map((name) => this.parameters[name]);
  }

  get poleLength() {
    return [2 * this.parameters.pole_com];
  }

  get trackEnd() {
    return [this.parameters.track_half_length];
  }

  /** Start an episode in a true state: m, m/s, rad, rad/s. */
  reset({ x, x_dot, theta, theta_dot }) {
    this.motion = [x, x_dot, theta, theta_dot];
    this.drive = new Array(1 + DATA.commands).fill(0);
    this.begin(encoderCounts(this.table, this.motion, NO_NOISE).counts);
    this.offTrack = false;
  }

  /** Take in the first counts of an episode. */
  begin(counts) {
    this.counts = counts;
    this.percept = perceiveFirst(counts, this.poleLength, this.trackEnd);
    this.motor = 0;
    this.fallen = false;
  }

  /** Take in the counts after a period of `dt` s in which `motor` drove. */
  see(counts, dt, motor) {
    const { state, past } = this.percept;
    this.percept = perceive(counts, [dt], this.counts, state, past, [motor], this.poleLength, this.trackEnd);
    Object.assign(this, { counts, motor });
    this.fallen = DATA.angleLimit !== null && Math.abs(this.percept.state[2]) > DATA.angleLimit;
  }

  /** The motor value that the agent and its track guard choose; null where a number is not finite. */
  chosen() {
    const values = actionValues(this.percept.observation);
    if (![...this.percept.observation, ...values].every(Number.isFinite)) return null;
    const side = this.percept.guard[0];
    return side ? DATA.inward.at(side) : DATA.motors[values.indexOf(Math.max(...values))];
  }

  /** Drive one control period. force: N on the cart; turn: rad/s^2 of the pole. */
  step(motor, force = 0, turn = 0) {
    const after = runPeriod(this.table, this.motion, this.drive, [motor], NO_NOISE, [force], [turn]);
    this.see(after.counts, DATA.period, motor);
    Object.assign(this, { motion: after.motion, drive: after.drive, offTrack: after.off_track[0] });
  }
}
