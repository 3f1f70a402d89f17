const WIRE = DATA.wire; // the protocol, and what the agent's cart has to report
const WRAP = 2 ** 32; // of ticks and microseconds
const SIZES = { B: [1, "Uint8"], H: [2, "Uint16"], h: [2, "Int16"], I: [4, "Uint32"], i: [4, "Int32"] };
const TYPES = Object.fromEntries(Object.entries(WIRE.messages).map(([name, { type }]) => [type, name]));
const LOST = "the cable to the cart was pulled, or the cart lost its power";

// frames

/** CRC-16/CCITT-FALSE. */
function crc16(bytes) {
  let register = 0xffff;
  for (const byte of bytes) {
    register ^= byte << 8;
    for (let bit = 0; bit < 8; bit++) register = ((register << 1) ^ (register & 0x8000 ? 0x1021 : 0)) & 0xffff;
  }
  return register;
}

function sizeOf(layout) {
  return [...layout].reduce((sum, code) => sum + SIZES[code][0], 0);
}

function packed(layout, values) {
  const view = new DataView(new ArrayBuffer(sizeOf(layout)));
  let at = 0;
  [...layout].forEach((code, number) => {
    const [size, kind] = SIZES[code];
    view[`set${kind}`](at, values[number], true);
    at += size;
  });
  return new Uint8Array(view.buffer);
}

function unpacked(layout, bytes) {
  const view = new DataView(Uint8Array.from(bytes).buffer);
  let at = 0;
  return [...layout].map((code) => {
    const [size, kind] = SIZES[code];
    at += size;
    return view[`get${kind}`](at - size, true);
  });
}

/** The bytes of a frame, the ending 0x00 included. Its COBS blocks are shorter than the longest one, 254 bytes. */
function encodedFrame(name, values, sequence, flags = 0) {
  const { type, layout } = WIRE.messages[name];
  const body = [WIRE.version, type, sequence, flags, ...packed(layout, values)];
  const bytes = [1];
  let start = 0; // of the block
  for (const byte of [...body, ...packed("H", [crc16(body)])]) {
    if (byte) bytes[start] = bytes.push(byte) - start;
    else start = bytes.push(1) - 1;
  }
  return Uint8Array.of(...bytes, 0);
}

/** A frame without its 0x00: version, name, sequence, flags, and the message's fields. Null if it is damaged. */
function decodedFrame(run) {
  const data = [];
  for (let at = 0; at < run.length; at += run[at]) {
    if (at + run[at] > run.length) return null;
    if (at) data.push(0);
    data.push(...run.slice(at + 1, at + run[at]));
  }
  const body = data.slice(0, -2), payload = body.slice(4), [version, type, sequence, flags] = body;
  if (body.length < 4 || crc16(body) !== unpacked("H", data.slice(-2))[0]) return null;
  if (version !== WIRE.version) return { version };
  const { layout, fields } = WIRE.messages[TYPES[type]] ?? {};
  if (layout === undefined || payload.length !== sizeOf(layout)) return null;
  const values = unpacked(layout, payload);
  const message = Object.fromEntries(fields.map((field, number) => [field, values[number]]));
  return { version, name: TYPES[type], sequence, flags, message };
}

/** Splits bytes at each 0x00; longer runs than any frame are dropped. */
class Splitter {
  run = [];

  *feed(bytes) {
    for (const byte of bytes) {
      if (byte) {
        if (this.run.length <= WIRE.longestFrame) this.run.push(byte);
        continue;
      }
      if (this.run.length && this.run.length <= WIRE.longestFrame) yield this.run;
      this.run = [];
    }
  }
}

// a cart

/** From `before` to `after`, ticks or microseconds that wrap. */
function between(before, after) {
  return (((after - before) % WRAP) + WRAP) % WRAP;
}

function seconds(before, after) {
  return between(before.time_us, after.time_us) * 1e-6;
}

/** True if the frame of a sequence was sent after that of another, or is the same. */
function isNewer(sequence, than) {
  return ((sequence - than) & 0xff) < 128;
}

function sentence(words) {
  return `${words[0].toUpperCase()}${words.slice(1)}.`;
}

/** A cart at a serial port, from the handshake to the end of one episode. Whatever ends it sends STOP first. */
class SerialCart {
  sequence = Math.floor(256 * Math.random()); // unlike that of the last host
  splitter = new Splitter();
  answers = [];
  last = null; // the newest STATE
  fresh = null; // the same, until it is answered
  bytes = 0; // that came
  states = 0; // that came
  lost = 0; // STATEs that did not come
  answered = 0;
  over = null; // why it ended, in words
  driving = false;
  asking = false; // a person, whether the cart may move
  agreed = false;
  connected = false;
  closing = false;
  done = false;
  line = "Connecting …"; // for the reader
  wake = () => {};

  /** `changed` is called with the s that passed since the last STATE, whenever `cart` has moved. */
  constructor(port, cart, changed) {
    Object.assign(this, { port, cart, changed });
  }

  /** Prepare the cart and drive an episode; return in words how it ended. The cart is stopped, the port closed. */
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
    this.driving = this.asking = false;
    const stopped = this.writer && (await this.stop());
    await this.close();
    const left = "the cart did not confirm that it is disarmed; our firmware stops it in half a second";
    this.line = stopped || !this.connected ? sentence(this.over) : `${sentence(this.over)} ${sentence(left)}`;
    this.done = true;
  }

  /** End it in the next moment. STOP goes out at once; `run` repeats it until it is acknowledged. */
  end(words) {
    if (this.over !== null) return;
    this.over = words;
    if (this.writer) this.send("STOP");
    this.wake();
  }

  check() {
    if (this.over !== null && !this.closing) throw new Error(this.over);
  }

  // bytes

  async open() {
    await this.port.open({ baudRate: WIRE.baud, bufferSize: 4096 });
    this.writer = this.port.writable.getWriter();
    this.reading = this.read();
    const low = { dataTerminalReady: false, requestToSend: false }; // a rise may restart the board
    await this.port.setSignals(low).catch(() => {}); // not every port has them
  }

  async read() {
    let error = null;
    while (this.port.readable && error?.name !== "NetworkError" && !this.closing) {
      this.reader = this.port.readable.getReader();
      try {
        for (let part = await this.reader.read(); !part.done; part = await this.reader.read()) {
          this.bytes += part.value.length;
          for (const run of this.splitter.feed(part.value)) this.take(decodedFrame(run));
          this.wake();
        }
      } catch (reason) {
        error = reason; // of bytes that were damaged or not read in time, the port goes on
      }
      this.reader.releaseLock();
    }
    this.end(LOST);
  }

  send(name, ...values) {
    this.sequence = (this.sequence + 1) & 0xff;
    const frame = encodedFrame(name, values, this.sequence);
    const bytes = name === "STOP" ? Uint8Array.of(0, ...frame) : frame; // 0x00 ends half a frame before it
    this.writer.write(bytes).catch(() => this.end(LOST));
    return this.sequence;
  }

  async stop() {
    this.closing = true;
    return this.ask("STOP", [], WIRE.stopAttempts).then(() => true, () => false);
  }

  async close() {
    this.closing = true;
    await this.reader?.cancel().catch(() => {});
    await this.reading;
    this.writer?.releaseLock();
    await this.port.close().catch(() => {});
  }

  // frames

  take(frame) {
    if (frame === null) return;
    if (frame.version !== WIRE.version) this.otherVersion = frame.version;
    else if (frame.name === "STATE") this.takeState({ ...frame.message, flags: frame.flags });
    else if (frame.name === "NACK" && frame.message.type === WIRE.messages.SET_MOTOR.type) this.refused = frame.message;
    else this.answers.push({ ...frame, states: this.states });
  }

  takeState(state) {
    if (this.last && between(state.tick, this.last.tick) < WIRE.overtakenTicks) return; // a copy, or overtaken
    const ticks = this.last ? between(this.last.tick, state.tick) : 1;
    if (ticks <= WRAP / 2) this.lost += ticks - 1;
    else if (this.connected) this.end("the cart has restarted; check its power");
    this.states += 1;
    this.last = this.fresh = state;
  }

  /** Wait until something comes, for `ms` at most, and until all that has come is read. */
  async event(ms) {
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, ms);
      this.wake = () => resolve(clearTimeout(timer));
    });
    await scheduler.postTask(() => {}, { priority: "user-blocking" });
    this.check();
  }

  /** Ask until the cart answers; return the answer, and the sequence of the first frame that asked. */
  async ask(name, values = [], attempts = WIRE.attempts, fits = () => true) {
    const asked = [], kind = name === "HELLO" || name === "SET_PERIOD" ? "INFO" : "ACK";
    this.check();
    while (asked.length < attempts) {
      asked.push(this.send(name, ...values));
      const deadline = performance.now() + 1000 * WIRE.answerTimeout;
      while (performance.now() < deadline) {
        await this.event(deadline - performance.now());
        for (const { name: answered, message, states } of this.answers.splice(0)) {
          const isOurs = message.type === WIRE.messages[name].type && asked.includes(message.sequence);
          const done = answered === "NACK" && isOurs && message.reason === WIRE.busy && asked.length > 1;
          if (answered === "NACK" && isOurs && !done) throw new Error(this.refusal(message));
          if (done || (answered === kind && (kind === "INFO" ? fits(message) : isOurs))) {
            return { ...message, states, first: asked[0] }; // BUSY: the first one was heard, its ACK was lost
          }
        }
      }
    }
    throw new Error(`the cart did not answer ${name}, asked ${attempts} times: check its cable and power`);
  }

  /** The newest STATE, each at most once; with `since`, one that was measured after that frame was taken. */
  async state(since = null) {
    for (const deadline = performance.now() + 1000 * WIRE.timeout; ; ) {
      const state = this.fresh;
      this.fresh = null;
      if (state && (since === null || isNewer(state.last_sequence, since))) return state;
      const left = deadline - performance.now();
      if (left <= 0) throw new Error(`no state came for ${WIRE.timeout} s: check the cart's cable and power`);
      await this.event(left);
    }
  }

  refusal({ type, reason }) {
    return `the cart refused ${TYPES[type]}: ${WIRE.reasons[reason] ?? `reason ${reason}, unknown here`}`;
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
    const information = await this.ask("HELLO");
    const wrong = Object.entries(WIRE.cart).filter(([name, value]) => information[name] !== value);
    const words = wrong.map(([name, value]) => `${name} ${information[name]}, not ${value}`).join(", ");
    if (words) throw new Error(`this is not the agent's cart, it reports ${words}`);
    await this.ask("SET_PERIOD", [WIRE.period], WIRE.attempts, ({ period_us }) => period_us === WIRE.period);
    await this.checkLink();
  }

  whatCame() {
    if (!this.bytes) return "nothing came; is it powered, and is this the right port?";
    if (this.otherVersion === undefined) return `${this.bytes} bytes came but no frame; is ${WIRE.baud} its baud rate?`;
    return `it speaks protocol version ${this.otherVersion}, this page ${WIRE.version}: update its firmware, or this page`;
  }

  /** Refuse a link that takes over a period there and back: two states come before an answer. */
  async checkLink() {
    const trips = [];
    for (let trip = 0; trip < 5; trip++) {
      const before = this.states;
      trips.push((await this.ask("STOP")).states - before);
    }
    if (trips.sort()[2] > 1) throw new Error("the way to the cart and back takes over a period: use a short cable");
  }

  async home() {
    const { fault } = await this.state(this.sequence);
    await this.consent(fault);
    if (fault) await this.ask("CLEAR_FAULT");
    await this.checkLink();
    this.line = "The cart homes: it moves by itself, usually for 15 to 40 s.";
    const before = this.last, { first } = await this.ask("HOME");
    let state = await this.seen(first), renewed = before;
    while (state.flags & WIRE.flags.HOMING) {
      if (seconds(before, state) > WIRE.homeTimeout) throw new Error("homing took too long: clear the track");
      if (between(renewed.time_us, state.time_us) >= WIRE.lease) {
        this.send("HELLO");
        renewed = state;
      }
      state = await this.seen();
    }
    if (!(state.flags & WIRE.flags.HOMED)) throw new Error("the cart ended homing, as it did not hear this page");
    this.trust(await this.ask("HELLO"));
  }

  /** Wait until a person agrees that the cart moves. */
  async consent(fault) {
    const found = fault ? `${sentence(this.faults(fault))} If its cause is gone: ` : "";
    this.line = `${found}The cart moves by itself while it homes: keep the track clear, let the pole hang.`;
    this.asking = true;
    for (; !this.agreed; await this.seen()) this.send("HELLO");
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

  /** The next STATE of a cart that does not drive; it is shown. Raises an Error if it has a fault. */
  async seen(since = null) {
    const state = await this.state(since);
    if (state.fault && !this.asking) throw new Error(this.faults(state.fault));
    const homed = state.flags & WIRE.flags.HOMED, angle = (2 * Math.PI * state.pole_counts) / WIRE.turn;
    this.cart.motion = [WIRE.metres * state.cart_counts, 0, homed ? angle : Math.PI, 0];
    this.changed(0);
    return state;
  }

  /** Wait until the pole is still where episodes start. HELLO keeps an emulated cart without a clock going. */
  async awaitPole() {
    const { angle, tolerance, sway, remedy } = WIRE.start;
    this.line = sentence(`waiting for the pole to be still: ${remedy}`);
    const began = this.last;
    let still = [];
    for (let state = began; !still.length || seconds(still[0], state) < WIRE.still; ) {
      this.send("HELLO");
      state = await this.seen();
      if (!(state.flags & WIRE.flags.HOMED)) throw new Error("the cart has restarted; check its power");
      if (seconds(began, state) > WIRE.startTimeout) throw new Error(`the pole was not still in time: ${remedy}`);
      const theta = this.cart.motion[2];
      still.push({ time_us: state.time_us, theta });
      const angles = still.map((each) => each.theta);
      const spread = Math.max(...angles) - Math.min(...angles);
      if (Math.abs(wrapped(theta - angle)) > tolerance || spread > sway) still = [];
    }
  }

  // an episode

  async drive() {
    await this.checkLink();
    const { first } = await this.ask("START");
    let state = await this.state(first), drove = 0;
    const start = state, turns = WIRE.turn * Math.round(state.pole_counts / WIRE.turn - WIRE.start.angle / (2 * Math.PI));
    const counts = () => [state.cart_counts, state.pole_counts - turns];
    this.cart.begin(counts());
    this.driving = true;
    this.line = "The agent drives.";
    this.lost = this.answered = 0;
    this.judge(state, start);
    for (;;) {
      const sent = this.bounded(this.cart.chosen());
      const sequence = this.send("SET_MOTOR", sent, state.tick), before = state;
      this.answered += 1;
      state = await this.state();
      drove = this.inForce(before, state, sequence, sent, drove);
      const dt = seconds(before, state);
      if (!(dt > 0 && dt <= WIRE.suspension)) throw new Error(`${dt} s passed between two states`);
      this.cart.see(counts(), dt, drove);
      this.cart.motion = this.cart.percept.state;
      this.changed(dt);
      this.judge(state, start);
    }
  }

  /** A motor value within the limit, a whole number; 0 for anything else. */
  bounded(motor) {
    return Math.max(-WIRE.cart.motor_limit, Math.min(WIRE.cart.motor_limit, Math.trunc(motor) || 0));
  }

  /** The motor value that drove the period before `state`, by what the cart says of it. */
  inForce(before, state, sequence, sent, drove) {
    const { SOFT_LIMIT, WATCHDOG } = WIRE.flags;
    if (!(state.flags & SOFT_LIMIT) && state.last_sequence === sequence) return sent;
    const hasJustStopped = state.fault || state.flags & ~before.flags & WATCHDOG;
    return hasJustStopped && !(state.flags & SOFT_LIMIT) ? drove : state.motor_applied;
  }

  /** Raise an Error if a STATE ends the episode. */
  judge(state, start) {
    const ticks = between(start.tick, state.tick), { refused } = this;
    const overtaken = refused?.reason === WIRE.stale && isNewer(state.last_sequence, refused.sequence);
    const ends = [
      [state.fault & ~WIRE.hardLimit, () => this.faults(state.fault)],
      [Math.abs(state.cart_counts) >= this.soft || state.fault, () => "the cart reached the end of its track"],
      [!(state.flags & WIRE.flags.ARMED), () => "the cart is not armed any more: it has restarted; check its power"],
      [refused && !overtaken, () => this.refusal(refused)],
      [Math.abs(state.motor_applied) > WIRE.cart.motor_limit, () => "the cart reports a motor value that no cart has"],
      [
        ticks * DATA.period > WIRE.deafness && state.command_age_ms > 1000 * WIRE.deafness,
        () => `the cart has taken no motor value for ${WIRE.deafness} s: check its cable, end what keeps this computer busy`,
      ],
      [this.cart.fallen, () => "the pole fell"],
      [ticks >= WIRE.periods, () => `the episode is over: ${WIRE.periods * DATA.period} s`],
    ];
    this.refused = undefined;
    const end = ends.find(([is]) => is);
    if (end) throw new Error(end[1]());
  }
}

// the reader

async function connectCart() {
  const port = await navigator.serial.requestPort().catch(() => null);
  if (port === null) return; // the reader chose none
  real = new SerialCart(port, new Cart(simulated.parameters), (dt) => {
    time += dt;
    if (dt) record(dt);
    before = cart.motion;
  });
  cart = real.cart;
  history = [];
  forget();
  await real.run();
}

function drawSerial() {
  const running = real !== null && !real.done, text = real ? real.line : HINT;
  element("simulated").disabled = running;
  element("connect").hidden = running;
  element("connect").disabled = !navigator.serial;
  element("agree").hidden = !(running && real.asking);
  element("stop").hidden = !running;
  if (element("link").textContent !== text) element("link").textContent = text;
  element("states").textContent = real ? `${real.answered} states answered, ${real.lost} lost` : "";
}

const HINT = navigator.serial
  ? "The agent can drive a real cart with our firmware, at a serial port of this computer."
  : "To drive a real cart, open this page in Chrome or Edge on a computer: this browser has no Web Serial.";
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
