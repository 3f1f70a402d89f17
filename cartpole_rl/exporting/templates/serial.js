const WIRE = DATA.wire; // the protocol, the rules of a host, and what the agent's cart has to report
const SIZES = { B: [1, "Uint8"], H: [2, "Uint16"], h: [2, "Int16"], I: [4, "Uint32"], i: [4, "Int32"] };
const NAMES = Object.fromEntries(Object.entries(WIRE.messages).map(([name, { type }]) => [type, name]));
const LONGEST_CLOSE = 5000; // ms
const LOST = "the cable to the cart was pulled, or the cart lost its power";

// frames, as docs/protocol.md describes them

/** CRC-16/CCITT-FALSE. */
function crc16(bytes) {
  let register = 0xffff;
  for (const byte of bytes) {
    register ^= byte << 8;
    for (let bit = 0; bit < 8; bit++) register = ((register << 1) ^ (register & 0x8000 ? 0x1021 : 0)) & 0xffff;
  }
  return register;
}

/** Call `use(view, kind, place, number)` for each number of a layout; return the results. */
function laidOut(layout, bytes, use) {
  const view = new DataView(bytes.buffer);
  let end = 0;
  return [...layout].map((code, number) => {
    const [size, kind] = SIZES[code];
    end += size;
    return use(view, kind, end - size, number);
  });
}

function sizeOf(layout) {
  return [...layout].reduce((sum, code) => sum + SIZES[code][0], 0);
}

function packed(layout, values) {
  const bytes = new Uint8Array(sizeOf(layout));
  laidOut(layout, bytes, (view, kind, place, number) => view[`set${kind}`](place, values[number], true));
  return bytes;
}

function unpacked(layout, bytes) {
  return laidOut(layout, Uint8Array.from(bytes), (view, kind, place) => view[`get${kind}`](place, true));
}

/** The bytes of a frame with its 0x00. No frame is as long as the longest block of COBS, 254 bytes. */
function encodedFrame(name, values, sequence, flags = 0) {
  const { type, layout } = WIRE.messages[name];
  const body = [WIRE.version, type, sequence, flags, ...packed(layout, values)], bytes = [1];
  let block = 0; // where it starts
  for (const byte of [...body, ...packed("H", [crc16(body)])]) {
    if (byte) bytes[block] = bytes.push(byte) - block;
    else block = bytes.push(1) - 1;
  }
  return Uint8Array.of(...bytes, 0);
}

/** The frame in bytes without their 0x00; null if it is damaged, its version alone if that is another one. */
function decodedFrame(run) {
  const data = [];
  for (let at = 0; at < run.length; at += run[at]) {
    if (at + run[at] > run.length) return null;
    data.push(...(at ? [0] : []), ...run.slice(at + 1, at + run[at]));
  }
  const body = data.slice(0, -2), [version, type, sequence, flags] = body, payload = body.slice(4);
  if (body.length < 4 || crc16(body) !== unpacked("H", data.slice(-2))[0]) return null;
  if (version !== WIRE.version) return { version };
  const { layout, fields } = WIRE.messages[NAMES[type]] ?? {};
  if (!fields || payload.length !== sizeOf(layout)) return null;
  const values = unpacked(layout, payload);
  const message = Object.fromEntries(fields.map((field, number) => [field, values[number]]));
  return { version, name: NAMES[type], sequence, flags, message };
}

/** Yields each run of bytes that ends in 0x00, but none that is longer than a frame. */
class Splitter {
  run = [];

  *feed(bytes) {
    for (const byte of bytes) {
      if (byte && this.run.length <= WIRE.longestFrame) this.run.push(byte);
      if (byte) continue;
      if (this.run.length && this.run.length <= WIRE.longestFrame) yield this.run;
      this.run = [];
    }
  }
}

// a cart

/** Ticks, or microseconds, from one that wraps at 2^32 to a later one. */
function between(before, after) {
  return (after - before) >>> 0;
}

function seconds(before, after) {
  return between(before.time_us, after.time_us) * 1e-6;
}

/** True if the frame of a sequence was sent after that of another, or is the same. */
function isNewer(sequence, than) {
  return ((sequence - than) & 0xff) < 128;
}

function sentence(words) {
  return `${words[0].toUpperCase()}${words.slice(1)}${/[.?]$/.test(words) ? "" : "."}`;
}

/** A cart at a port of Web Serial, from the handshake to the end of one episode, whose end is always a STOP. */
class SerialCart {
  line = "Connecting …"; // for the reader
  over = null; // why it ended, in words
  done = false; // the port is closed, too
  asking = false; // the reader, whether the cart may move
  agreed = false;
  driving = false;
  connected = false;
  closing = false; // only the last STOP is left
  closed = false;
  answered = 0; // STATEs
  periods = 0; // since START
  states = 0; // that came
  bytes = 0; // that came
  newest = null; // STATE
  fresh = null; // the same until it is answered
  asked = null; // sequence of the last question, until a STATE acknowledges it
  answers = [];
  splitter = new Splitter();
  sequence = Math.floor(256 * Math.random()); // unlike that of the last host
  wake = () => {};

  /** `changed` is called when `cart` has moved, with the s that passed in an episode. */
  constructor(port, cart, changed) {
    Object.assign(this, { port, cart, changed });
  }

  /** Prepare the cart, drive an episode, stop the cart. `line` then says how it ended. */
  async run() {
    try {
      await this.open();
      await this.connect();
      await this.home();
      await this.awaitPole();
      await this.drive();
    } catch (error) {
      this.end(error.message);
    }
    this.closing = true;
    this.driving = this.asking = false;
    this.cart.motor = 0;
    this.line = sentence(this.over);
    const reached = this.connected && this.over !== LOST;
    const stopped = reached && (await this.ask("STOP", [], WIRE.stopAttempts).catch(() => null));
    if (this.connected && !stopped) this.line += " The cart did not confirm STOP; our firmware stops it by itself.";
    await this.close();
    this.done = true;
  }

  /** End it. A STOP goes out at once; `run` repeats it until it is acknowledged. */
  end(words) {
    if (this.over !== null) return;
    this.over = words;
    if (this.writer) this.send("STOP");
    this.wake();
  }

  // bytes

  async open() {
    await this.port.open({ baudRate: WIRE.baud, bufferSize: 4096 }).catch(({ message }) => {
      throw new Error(`${message} End other programs and pages that use the port, or reload this page.`);
    });
    this.writer = this.port.writable.getWriter();
    this.reading = this.read();
    const low = { dataTerminalReady: false, requestToSend: false }; // a rise may restart the board
    await this.port.setSignals(low).catch(() => {}); // not every port has them
  }

  async read() {
    let lost = false;
    while (this.port.readable && !lost && !this.closed) {
      this.reader = this.port.readable.getReader();
      try {
        for (let part = await this.reader.read(); !part.done; part = await this.reader.read()) {
          this.bytes += part.value.length;
          for (const run of this.splitter.feed(part.value)) this.take(decodedFrame(run));
          this.wake();
        }
        lost = true; // a stream that ends has no successor
      } catch (error) {
        lost = error.name === "NetworkError"; // after a damaged byte the port goes on with a new stream
      }
      this.reader.releaseLock();
    }
    this.end(LOST);
  }

  send(name, ...values) {
    this.sequence = (this.sequence + 1) & 0xff;
    const frame = encodedFrame(name, values, this.sequence);
    const bytes = name === "STOP" ? Uint8Array.of(0, ...frame) : frame; // 0x00 ends half a frame before it
    const writer = this.writer;
    writer?.write(bytes).catch(() => this.renewWriter(writer));
    return this.sequence;
  }

  /** End it after an error of `writer`. The port then has a new stream, unless its cable was pulled. */
  renewWriter(writer) {
    if (this.closed || writer !== this.writer) return;
    writer.releaseLock();
    this.writer = this.port.writable?.getWriter();
    this.end(this.writer ? "the port took no bytes: check its cable, then connect again" : LOST);
  }

  /** Give the port back. A browser can wait without end for a device that takes no bytes. */
  async close() {
    this.closed = true;
    const closed = this.giveBack();
    await Promise.race([closed, new Promise((resolve) => setTimeout(resolve, LONGEST_CLOSE))]);
  }

  async giveBack() {
    await this.reader?.cancel().catch(() => {});
    await this.reading;
    this.writer?.releaseLock();
    await this.port.close().catch(() => {});
  }

  // frames

  take(frame) {
    if (frame === null) return;
    const { version, name, message, flags } = frame;
    if (version !== WIRE.version) this.otherVersion = version;
    else if (name === "STATE") this.takeState({ ...message, flags });
    else if (name === "NACK" && NAMES[message.type] === "SET_MOTOR") this.refused = message;
    else this.answers.push({ name, message: { ...message, flags }, states: this.states });
  }

  takeState(state) {
    if (this.newest && between(state.tick, this.newest.tick) < WIRE.overtaken) return; // a copy, or overtaken
    const restarted = this.newest && between(this.newest.tick, state.tick) > between(state.tick, this.newest.tick);
    if (restarted && this.connected) this.end("the cart has restarted; check its power");
    this.states += 1;
    this.newest = this.fresh = state;
    if (this.asked !== null && isNewer(state.last_sequence, this.asked)) this.asked = null;
  }

  /** Wait until something comes, for `ms` at most, and then until all that has come is read. */
  async event(ms) {
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, ms);
      this.wake = () => resolve(clearTimeout(timer));
    });
    await scheduler.postTask(() => {}, { priority: "user-blocking" });
    this.check();
  }

  check() {
    if (this.over !== null && !this.closing) throw new Error(this.over);
  }

  /** Ask until the cart answers. Return the answer. */
  async ask(name, values = [], attempts = WIRE.attempts, fits = () => true) {
    const asked = [], isInfo = ["HELLO", "SET_PERIOD"].includes(name);
    this.answers = []; // INFO of an earlier HELLO has earlier limits
    while (asked.length < attempts) {
      this.check();
      asked.push(this.send(name, ...values));
      this.asked = asked[0];
      for (const end = performance.now() + 1000 * WIRE.answerTimeout; performance.now() < end; ) {
        await this.event(end - performance.now());
        for (const { name: kind, message, states } of this.answers.splice(0)) {
          const { type, sequence, reason } = message, isOurs = NAMES[type] === name && asked.includes(sequence);
          if (kind === "NACK" && isOurs) throw Object.assign(new Error(this.refusal(message)), { reason });
          if (isInfo ? kind === "INFO" && fits(message) : isOurs) return { ...message, states };
        }
      }
    }
    throw new Error(`the cart did not answer ${name}, asked ${attempts} times: check its cable and power`);
  }

  /** The newest STATE, each at most once; with `taken`, one that was measured after the last question was taken. */
  async state(taken = false) {
    for (const end = performance.now() + 1000 * WIRE.timeout; ; ) {
      this.check(); // after a STOP, no motor value
      const state = this.fresh, left = end - performance.now();
      this.fresh = null;
      if (state && !(taken && this.asked !== null)) return state;
      if (left <= 0) throw new Error(`no state came for ${WIRE.timeout} s: check the cart's cable and power`);
      await this.event(left);
    }
  }

  refusal({ type, reason }) {
    return `the cart refused ${NAMES[type]}: ${WIRE.reasons[reason] ?? `reason ${reason}, unknown here`}`;
  }

  faults(bits) {
    const words = Object.entries(WIRE.faults).filter(([bit]) => bits & bit).map(([, each]) => each);
    return `the cart latched a fault: ${words.join("; ") || `bits ${bits}, unknown here`}`;
  }

  // the way to an episode

  async connect() {
    try {
      for (let stops = 0; stops < WIRE.stops; stops++) await this.ask("STOP", [], WIRE.connectAttempts);
    } catch (error) {
      throw new Error(this.over ?? `no cart answers: ${this.whatCame()}`);
    }
    this.connected = true;
    const information = await this.ask("HELLO"), { LEFT_SWITCH, RIGHT_SWITCH } = WIRE.flags;
    const found = { ...information, switches: information.flags & (LEFT_SWITCH | RIGHT_SWITCH) };
    const other = Object.entries(WIRE.cart).filter(([name, value]) => found[name] !== value);
    const words = other.map(([name, value]) => `${name} ${found[name]}, not ${value}`).join(", ");
    if (words) throw new Error(`this cart is not of the agent's kind; it reports ${words}`);
    await this.ask("SET_PERIOD", [WIRE.period], WIRE.attempts, ({ period_us }) => period_us === WIRE.period);
  }

  whatCame() {
    if (this.otherVersion === undefined) return `${this.bytes} bytes came; is it powered, and is this its port?`;
    return `it speaks protocol version ${this.otherVersion}, this page ${WIRE.version}; update its firmware, or the page`;
  }

  /** Refuse a link that takes over a period there and back: two states come before an answer. */
  async checkLink() {
    const trips = [];
    while (trips.length < WIRE.trips) {
      const before = this.states;
      trips.push((await this.ask("STOP")).states - before);
    }
    const median = trips.sort((a, b) => a - b)[trips.length >> 1];
    if (median > 1) throw new Error("the way to the cart and back takes over a period: use a short cable");
  }

  async home() {
    await this.checkLink();
    let { fault } = await this.state();
    for (let shown = null; shown !== fault; fault = this.newest.fault) { // another one may latch meanwhile
      shown = fault;
      await this.consent(fault ? `${sentence(this.faults(fault))} If its cause is gone: ` : "");
    }
    if (fault) await this.ask("CLEAR_FAULT");
    this.line = "The cart homes: it moves by itself, usually for 15 to 40 s.";
    const before = this.newest;
    let state = await this.beginHoming(before), renewed = before;
    for (; state.flags & WIRE.flags.HOMING; state = await this.seen()) {
      if (seconds(before, state) > WIRE.homeTimeout) throw new Error("homing took too long: clear the track");
      if (between(renewed.time_us, state.time_us) < WIRE.lease) continue;
      this.send("HELLO");
      renewed = state;
    }
    if (!(state.flags & WIRE.flags.HOMED)) throw new Error("homing ended, as the cart did not hear this page");
    this.trust(await this.ask("HELLO"));
  }

  /** Ask for HOME, again while the cart's brake acts. Return the first STATE since. */
  async beginHoming(before) {
    const { ARMED, HOMING } = WIRE.flags;
    for (;;) {
      try {
        await this.ask("HOME");
        return await this.seen(true);
      } catch (error) {
        if (error.reason !== WIRE.busy) throw error;
        await this.ask("HELLO");
        const state = await this.seen(true);
        if (state.flags & HOMING) return state; // only the ACK was lost
        if (state.flags & ARMED || seconds(before, state) > WIRE.homeTimeout) throw error;
      }
    }
  }

  /** Wait until the reader agrees that the cart moves. HELLO keeps an emulated cart without a clock going. */
  async consent(found) {
    const length = `Is your pole ${this.cart.poleLength[0].toFixed(2)} m long?`;
    const other = "If not, press Stop, choose its length, and connect again.";
    const asked = `${found}${WIRE.needsLength ? `${length} ${other} ` : ""}`;
    this.line = `${asked}The cart moves by itself while it homes: keep the track clear, let the pole hang.`;
    this.agreed = false;
    for (this.asking = true; !this.agreed; await this.seen()) this.send("HELLO");
    this.asking = false;
  }

  /** Take over the limits of the track, which homing has measured. */
  trust({ soft_limit_counts: soft, hard_limit_counts: hard }) {
    const [least, most] = WIRE.limits, metres = WIRE.metres;
    if (!(least < soft * metres && soft < hard && hard * metres < most)) {
      throw new Error(`the cart reports limits of ${soft} and ${hard} counts, which do not fit its track`);
    }
    this.soft = soft;
    this.cart.parameters.track_half_length = soft * metres;
  }

  /** The next STATE of a cart that the agent does not drive. Before homing its angle means nothing. */
  async seen(taken = false) {
    const state = await this.state(taken);
    if (state.fault && !this.asking) throw new Error(this.faults(state.fault));
    const angle = state.flags & WIRE.flags.HOMED ? (2 * Math.PI * state.pole_counts) / WIRE.turn : Math.PI;
    Object.assign(this.cart, { motion: [WIRE.metres * state.cart_counts, 0, angle, 0], motor: state.motor_applied });
    this.changed(0);
    return state;
  }

  /** Wait until the pole is still where episodes start. */
  async awaitPole() {
    const { angle, tolerance, sway, remedy } = WIRE.start, began = this.newest;
    this.line = sentence(`waiting for the pole to be still: ${remedy}`);
    let still = [];
    for (let state = began; !still.length || seconds(still[0], state) < WIRE.still; ) {
      this.send("HELLO");
      state = await this.seen();
      const away = Math.abs(state.cart_counts) > WIRE.offCentre;
      const late = away ? "the cart is off the middle of its track: bring it back" : `the pole was not still in time: ${remedy}`;
      if (seconds(began, state) > WIRE.startTimeout) throw new Error(late);
      const theta = this.cart.motion[2];
      still.push({ time_us: state.time_us, theta });
      const angles = still.map((each) => each.theta), spread = Math.max(...angles) - Math.min(...angles);
      if (away || Math.abs(wrapped(theta - angle)) > tolerance || spread > sway) still = [];
    }
  }

  // an episode

  async drive() {
    await this.checkLink();
    await this.ask("START");
    const start = await this.state(true), cart = this.cart;
    const turns = WIRE.turn * Math.round(start.pole_counts / WIRE.turn - WIRE.start.angle / (2 * Math.PI));
    const counts = (state) => [state.cart_counts, state.pole_counts - turns];
    this.driving = true;
    this.line = "The agent drives.";
    cart.begin(counts(start));
    for (let state = start; ; this.periods = between(start.tick, state.tick)) {
      this.judge(state);
      const before = state, motor = cart.chosen();
      if (motor === null) throw new Error("the agent gave a number that is not finite");
      const sent = this.bounded(motor), sequence = this.send("SET_MOTOR", sent, before.tick);
      this.answered += 1;
      state = await this.state();
      const dt = seconds(before, state);
      if (!(dt > 0 && dt <= WIRE.suspension)) throw new Error(`${dt} s passed between two states`);
      cart.see(counts(state), dt, this.inForce(before, state, sequence, sent));
      cart.motion = cart.percept.state;
      this.changed(dt);
    }
  }

  /** A motor value within the limit, a whole number; 0 in place of anything else. */
  bounded(motor) {
    return Math.max(-WIRE.cart.motor_limit, Math.min(WIRE.cart.motor_limit, Math.trunc(motor) || 0));
  }

  /** The motor value that drove the period before `state`: the one sent, or what the cart made of it. */
  inForce(before, state, sequence, sent) {
    if (state.flags & WIRE.flags.SOFT_LIMIT) return state.motor_applied;
    if (state.last_sequence === sequence) return sent;
    return state.fault || state.flags & ~before.flags & WIRE.flags.WATCHDOG ? this.cart.motor : state.motor_applied;
  }

  /** Raise an Error if a STATE ends the episode. */
  judge({ tick, fault, flags, cart_counts, last_sequence, motor_applied, command_age_ms }) {
    const refused = this.refused, limit = WIRE.cart.motor_limit, deaf = WIRE.deafness;
    const overtaken = refused?.reason === WIRE.stale && isNewer(last_sequence, refused.sequence);
    const end = (is, words) => {
      if (is) throw new Error(words());
    };
    this.refused = undefined;
    end(fault & ~WIRE.hardLimit, () => this.faults(fault));
    end(fault || Math.abs(cart_counts) >= this.soft, () => "the cart reached the end of its track");
    end(!(flags & WIRE.flags.ARMED), () => "the cart is not armed any more; check its power");
    end(refused && !overtaken, () => this.refusal(refused));
    end(Math.abs(motor_applied) > limit, () => `STATE ${tick} has motor value ${motor_applied}, beyond ${limit}`);
    end(
      Math.min(this.periods * DATA.period, command_age_ms / 1000) > deaf,
      () => `the cart took no motor value for ${deaf} s: check its cable, end what keeps this computer busy`,
    );
    end(this.cart.fallen, () => "the pole fell");
    end(this.periods >= WIRE.periods, () => `the episode is over, after ${WIRE.periods * DATA.period} s`);
  }
}

// the reader

const HINT = navigator.serial
  ? "The agent can drive a real cart with our firmware, at a serial port of this computer."
  : "To drive a real cart, open this page in Chrome or Edge on a computer: this browser has no Web Serial.";

async function connectCart() {
  const port = await navigator.serial.requestPort().catch(() => null);
  if (port === null || (real && !real.done)) return; // the reader chose none, or pressed twice
  real = new SerialCart(port, new Cart(simulated.parameters), (dt) => {
    before = cart.motion;
    time += dt;
    if (dt) record(dt);
  });
  cart = real.cart;
  history = [];
  forget();
  await real.run();
}

function drawSerial() {
  const running = real !== null && !real.done, text = real ? real.line : HINT;
  element("simulated").disabled = element("connect").hidden = running;
  element("connect").disabled = !navigator.serial;
  element("agree").hidden = !(running && real.asking);
  element("stop").hidden = !running;
  if (element("link").textContent !== text) element("link").textContent = text;
  const missed = real && Math.max(0, real.periods - real.answered); // lost, or another one had come
  element("states").textContent = real?.answered ? `${real.answered} states answered, ${missed} missed` : "";
}

element("connect").addEventListener("click", connectCart);
element("agree").addEventListener("click", () => (real.agreed = true));
element("stop").addEventListener("click", () => real.end("stopped by hand"));
window.addEventListener("keydown", (event) => {
  if (event.key === "Escape") real?.end("stopped by hand");
});
document.addEventListener("visibilitychange", () => {
  if (document.hidden) real?.end("the page was hidden, where a browser slows it down: keep it in view");
});
window.addEventListener("pagehide", () => real?.end("the page was closed"));
