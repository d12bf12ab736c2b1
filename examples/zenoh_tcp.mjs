// SPDX-License-Identifier: Apache-2.0
// A Zenoh peer in plain JavaScript: other peers connect to it by TCP; it subscribes to keys and puts messages.
//
// Node has no Zenoh binding for TCP (zenoh-ts needs a plugin of a router). This is the part of the protocol, version 9, that
// a simulator needs: sessions without extensions, put, subscribe. Queries and fragments are not in it.
// Source: eclipse-zenoh, zenoh-protocol and zenoh-codec, and zenoh-pico, src/protocol/codec.
import { randomBytes } from "node:crypto";
import { createServer } from "node:net";

const [INIT, OPEN, CLOSE, KEEP_ALIVE, FRAME] = [1, 2, 3, 4, 5]; // of a session
const [OAM, DECLARE, PUSH, INTEREST] = [0x1f, 0x1e, 0x1d, 0x19]; // in a frame
const [KEY, SUBSCRIBER, FINAL] = [0, 2, 0x1a]; // declarations
const [A, N, M, Z] = [0x20, 0x20, 0x40, 0x80]; // flags: answer; named; sender's mapping; extensions
const VERSION = 9;
const PEER = 1;
const RESOLUTION = 0x0a; // sequence numbers and requests of 32 bits
const SEQUENCE_MASK = 0x0fffffff; // 4 bytes of 7 bits
const BATCH = 65535; // bytes
const LEASE_MS = 10000;

/** A number in groups of 7 bits, the lowest first. */
const zint = (n) => (n < 128 ? [n] : [(n % 128) | 128, ...zint(Math.floor(n / 128))]);
const slice = (bytes) => Buffer.concat([Buffer.from(zint(bytes.length)), bytes]);
const key = (name) => Buffer.concat([Buffer.from([0]), slice(Buffer.from(name))]); // without a mapping
const bytes = (...parts) => Buffer.concat(parts.map((part) => (Array.isArray(part) ? Buffer.from(part) : part)));

/** Reads a batch from its begin to its end. */
class Reader {
  constructor(data) {
    this.data = data;
    this.place = 0;
  }
  get isAtEnd() {
    return this.place >= this.data.length;
  }
  byte() {
    if (this.isAtEnd) throw new Error("the batch ends early");
    return this.data[this.place++];
  }
  zint() {
    let value = 0;
    for (let scale = 1; ; scale *= 128) {
      const byte = this.byte();
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
  }
  slice(length = this.zint()) {
    this.place += length;
    return this.data.subarray(this.place - length, this.place);
  }
  timestamp() {
    this.zint();
    this.slice(); // the clock's owner
  }
  body(encoding) {
    if (encoding === 0x20) this.zint();
    if (encoding === 0x40) this.slice();
  }
  extensions(header) {
    for (let more = header & Z; more; ) {
      const extension = this.byte();
      this.body(extension & 0x60);
      more = extension & Z;
    }
  }
  key(isNamed, names) {
    const prefix = names.get(this.zint()) ?? "";
    return prefix + (isNamed ? this.slice().toString() : "");
  }
}

/** Another peer's connection. */
class Session {
  constructor(socket, zid, subscriptions, onPut) {
    Object.assign(this, { socket, zid, subscriptions, onPut, sequence: 0, isOpen: false });
    this.names = new Map([[0, ""]]); // of keys that the other peer declared
    this.received = Buffer.alloc(0);
    socket.setNoDelay(true);
    socket.on("data", (data) => this.receive(data));
    socket.on("error", () => socket.destroy());
  }

  receive(data) {
    this.received = Buffer.concat([this.received, data]);
    while (this.received.length >= 2 && this.received.length >= 2 + this.received.readUInt16LE()) {
      const end = 2 + this.received.readUInt16LE();
      this.transport(new Reader(this.received.subarray(2, end)));
      this.received = this.received.subarray(end);
    }
  }

  send(...parts) {
    const batch = bytes(...parts);
    const length = Buffer.alloc(2);
    length.writeUInt16LE(batch.length);
    this.socket.write(Buffer.concat([length, batch]));
  }

  frame(...parts) {
    this.send([FRAME | 0x20], zint(this.sequence), ...parts); // reliable
    this.sequence = (this.sequence + 1) & SEQUENCE_MASK;
  }

  transport(reader) {
    const header = reader.byte();
    const kind = header & 0x1f;
    if (kind === INIT && !(header & A)) {
      const size = Buffer.alloc(2);
      size.writeUInt16LE(BATCH);
      const identity = [((this.zid.length - 1) << 4) | PEER];
      this.send([INIT | A | 0x40, VERSION], identity, this.zid, [RESOLUTION], size, slice(Buffer.from("zenav")));
    } else if (kind === OPEN && !(header & A)) {
      this.send([OPEN | A], zint(LEASE_MS), zint(this.sequence));
      this.isOpen = true;
      this.subscriptions.forEach((name, i) => this.frame([DECLARE, SUBSCRIBER | N | M], zint(i + 1), key(name)));
    } else if (kind === FRAME) {
      reader.zint();
      reader.extensions(header);
      while (!reader.isAtEnd) this.network(reader);
    } else if (kind === CLOSE) {
      this.socket.destroy();
    }
  }

  keepAlive() {
    this.send([KEEP_ALIVE]);
  }

  network(reader) {
    const header = reader.byte();
    const kind = header & 0x1f;
    if (kind === PUSH) {
      const name = reader.key(header & N, this.names);
      reader.extensions(header);
      const put = reader.byte();
      if ((put & 0x1f) !== 1) throw new Error("only puts are read");
      if (put & 0x20) reader.timestamp();
      if (put & 0x40 && reader.zint() & 1) reader.slice(); // its encoding, and the encoding's schema
      reader.extensions(put);
      const payload = reader.slice();
      if (this.subscriptions.includes(name)) this.onPut(name, payload); // peers send others, too
    } else if (kind === DECLARE) {
      if (header & 0x20) reader.zint();
      reader.extensions(header);
      this.declaration(reader);
    } else if (kind === INTEREST) {
      const interest = reader.zint();
      const mode = header & 0x60;
      const options = mode ? reader.byte() : 0;
      if (options & 0x10) reader.key(options & N, this.names);
      reader.extensions(header);
      if (mode & 0x20) this.frame([DECLARE | 0x20], zint(interest), [FINAL]); // all is declared already
    } else if (kind === OAM) {
      reader.zint();
      reader.extensions(header);
      reader.body(header & 0x60);
    } else {
      reader.place = reader.data.length; // requests and their answers: nothing here has any
    }
  }

  declaration(reader) {
    const header = reader.byte();
    const kind = header & 0x1f;
    if (kind === FINAL) return reader.extensions(header);
    const id = reader.zint();
    const name = kind % 2 === 0 ? reader.key(header & N, this.names) : ""; // odd ones take a declaration back
    if (kind === KEY) this.names.set(id, name);
    reader.extensions(header);
  }
}

/** Waits for peers on a port of this computer. onPut(name, payload) gets what comes on the keys `subscriptions`. */
export function listen(port, subscriptions, onPut) {
  const sessions = new Set();
  const zid = randomBytes(16);
  const server = createServer((socket) => {
    const session = new Session(socket, zid, subscriptions, onPut);
    sessions.add(session);
    socket.on("close", () => sessions.delete(session));
  });
  server.listen(port, "127.0.0.1");
  const open = () => [...sessions].filter((session) => session.isOpen);
  setInterval(() => open().forEach((session) => session.keepAlive()), LEASE_MS / 4).unref();
  return {
    put: (name, payload) => open().forEach((session) => session.frame([PUSH | N | M], key(name), [1], slice(payload))),
  };
}
