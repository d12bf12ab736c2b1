// SPDX-License-Identifier: Apache-2.0
// Messages of zenav in JavaScript, by docs/wire.md. It needs @msgpack/msgpack.
import { Decoder, Encoder } from "@msgpack/msgpack";

const decoder = new Decoder({ useBigInt64: true }); // stamps are ns, over 2^53
const encoder = new Encoder({ useBigInt64: true });

const DTYPES = [
  { name: "float32", size: 4, at: (view, i) => view.getFloat32(i, true) },
  { name: "float64", size: 8, at: (view, i) => view.getFloat64(i, true) },
  { name: "int8", size: 1, at: (view, i) => view.getInt8(i) },
  { name: "uint8", size: 1, at: (view, i) => view.getUint8(i) },
  { name: "int32", size: 4, at: (view, i) => view.getInt32(i, true) },
];

/** An array from its bin: nested lists of numbers. */
export function array(bin) {
  const view = new DataView(bin.buffer, bin.byteOffset, bin.byteLength);
  const dtype = DTYPES[bin[0]];
  const lengths = [4, 8, 12].slice(0, bin[1]).map((place) => view.getUint32(place, true));
  let place = 16;
  const read = ([length, ...inner]) =>
    Array.from({ length }, () => {
      if (inner.length > 0) return read(inner);
      place += dtype.size;
      return dtype.at(view, place - dtype.size);
    });
  return read(lengths);
}

/** A message as an object. defs: `$defs` of `zenav schema --json`; name: its class. int64 fields are BigInt. */
export function decode(bytes, name, defs) {
  return value(decoder.decode(bytes), { $ref: `#/$defs/${name}` }, defs);
}

function value(raw, schema, defs) {
  if (schema.$ref !== undefined) schema = defs[schema.$ref.split("/").pop()];
  if (schema["x-dtype"] !== undefined) return array(raw);
  if (schema.properties !== undefined) {
    const known = Object.entries(raw).filter(([key]) => key in schema.properties);
    return Object.fromEntries(known.map(([key, item]) => [key, value(item, schema.properties[key], defs)]));
  }
  if (!Array.isArray(raw)) return raw;
  return raw.map((item, i) => value(item, schema.prefixItems?.[i] ?? schema.items ?? {}, defs));
}

/** The bytes of a frame or message. */
export function encode(tree) {
  return encoder.encode(tree);
}

/** The tree of bytes whose classes are not known, like a frame of the page. */
export function unpack(bytes) {
  return decoder.decode(bytes);
}
