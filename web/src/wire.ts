// SPDX-License-Identifier: Apache-2.0
// Bytes of a message (docs/messages.md) to an object. The tables of messages.ts say which fields are arrays.

import { decode, encode } from "@msgpack/msgpack";

import { ARRAYS, type Grid, type Key, type MessageOf } from "./messages";

const HEADER_BYTES = 16; // dtype u8, axes u8, two bytes of padding, three lengths u32, as shared/codec.py packs them

type Values = Float32Array | Float64Array | Int8Array | Uint8Array | Int32Array;
type Fields = Record<string, unknown>;

const DTYPES: readonly [string, new (buffer: ArrayBuffer) => Values][] = [
  ["f4", Float32Array],
  ["f8", Float64Array],
  ["i1", Int8Array],
  ["u1", Uint8Array],
  ["i4", Int32Array],
];

/** The bytes are not a message of the key; the text says why. */
export class WireError extends Error {}

/** The message in `payload`. Raises WireError. The envelope stays under "@". */
export function decodeMessage<K extends Key>(topic: K, payload: Uint8Array): MessageOf[K] {
  const tree = decodeMap(payload);
  for (const [path, kind] of Object.entries<string>(ARRAYS[topic] ?? {})) {
    const [list, inner] = path.split("[].") as [string, string | undefined];
    if (inner === undefined) {
      if (tree[path] !== undefined) tree[path] = decodeArray(tree[path], kind, path);
    } else if (Array.isArray(tree[list])) {
      for (const item of tree[list] as Fields[]) item[inner] = decodeArray(item[inner], kind, path);
    }
  }
  if (typeof tree["stamp"] !== "number") throw new WireError("no stamp");
  return tree as unknown as MessageOf[K];
}

/** A frame's or message's msgpack map. Raises WireError. */
export function decodeMap(bytes: Uint8Array): Fields {
  let tree: unknown;
  try {
    tree = decode(bytes);
  } catch (error) {
    throw new WireError(`not msgpack: ${String(error)}`);
  }
  if (tree === null || typeof tree !== "object" || Array.isArray(tree)) throw new WireError("not a map");
  return tree as Fields;
}

/** The bytes of a frame. Numbers that are whole become integers; the server takes these for floats too. */
export function encodeFrame(frame: object): Uint8Array<ArrayBuffer> {
  return encode(frame, { ignoreUndefined: true });
}

/** The bin of a float64 array of one axis, as messages and requests carry it. */
export function encodeFloat64s(values: readonly number[]): Uint8Array {
  const bytes = new Uint8Array(HEADER_BYTES + 8 * values.length);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, DTYPES.findIndex(([name]) => name === "f8"));
  view.setUint8(1, 1);
  view.setUint32(4, values.length, true);
  values.forEach((value, i) => view.setFloat64(HEADER_BYTES + 8 * i, value, true));
  return bytes;
}

/** The values of an array's bin, copied where its place in memory does not fit the type. */
function decodeArray(value: unknown, kind: string, field: string): Values | Grid<Values> {
  if (!(value instanceof Uint8Array) || value.length < HEADER_BYTES) throw new WireError(`${field}: not an array`);
  const [dtype, axes] = kind.split(" ");
  const header = new DataView(value.buffer, value.byteOffset, HEADER_BYTES);
  const [name, type] = DTYPES[header.getUint8(0)] ?? ["", Uint8Array];
  const nAxes = header.getUint8(1);
  if (name !== dtype || nAxes !== Number(axes ?? 1)) throw new WireError(`${field}: not ${kind}`);
  const values = new type(value.slice(HEADER_BYTES).buffer);
  const rows = header.getUint32(4, true);
  const columns = header.getUint32(8, true);
  if (values.length !== (nAxes === 2 ? rows * columns : rows)) throw new WireError(`${field}: bytes do not fit its shape`);
  return nAxes === 2 ? { rows, columns, values } : values;
}
