# SPDX-License-Identifier: Apache-2.0
"""Messages as text for other programs: the fields of a class, and a name that changes with them."""

import hashlib
import json
from typing import Any, get_args, get_origin

import numpy as np

from shared.codec import fields_of, once_per_class, plain_kind, wire_dtype
from shared.messages import Message


@once_per_class
def schema(type_: type[Message]) -> bytes:
    """JSON text that describes a message for other programs: MCAP schema data, docs, the page's types."""
    rows = [
        {
            "name": field.name,
            "type": _type_name(field.kind),
            "unit": field.unit,
            **({"within": [field.within.low, field.within.high]} if field.within else {}),
            **({"nan": True} if field.within and field.within.nan else {}),
            **({"inf": True} if field.within and field.within.inf else {}),
            **({"shape": field.shape.axes} if field.shape else {}),
        }
        for field in fields_of(type_)
    ]
    doc = " ".join((type_.__doc__ or "").split())
    return json.dumps({"name": type_.__name__, "doc": doc, "encoding": "zenav msgpack", "fields": rows}).encode()


@once_per_class
def schema_id(type_: type[Message]) -> str:
    """`LaserScan-1a2b3c4d`: the name and a hash of the fields; a field with a default is compatible and not hashed."""
    rows = [(f.name, _type_name(f.kind)) for f in fields_of(type_) if f.required]
    return f"{type_.__name__}-{hashlib.sha256(repr(rows).encode()).hexdigest()[:8]}"


def _type_name(kind: Any) -> str:
    if get_origin(kind) is np.ndarray:
        return f"{wire_dtype(kind).name}[]"
    if get_origin(kind) is tuple:
        return f"[{', '.join('...' if k is Ellipsis else _type_name(plain_kind(k)) for k in get_args(kind))}]"
    return str(getattr(kind, "__name__", kind))
