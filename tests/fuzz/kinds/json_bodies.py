"""Bodies in JSON that are long, deep, wrong or cut off."""

from __future__ import annotations

import json
from collections.abc import Callable

from tests.fuzz.cost import MIB, Request
from tests.fuzz.kinds.requests import (
    BODY,
    JSON_TYPE,
    Rng,
    World,
    a_call,
    a_member,
    calls,
    chunks,
    head,
    kind,
    pick,
    post,
    repeated,
    size,
    spliced,
)

#: Elements that are invalid in every list, valid in some, or as short as possible.
ELEMENTS = (
    b'""', b"null", b"true", b"{}", b"[]", b"0", b"-1", b"1e400", b"0.1", b"NaN", b"Infinity", b'"\\ud800"', b'"a"',
    b"[0]", b"[0,0,0]", b'{"a":0}', b"[[]]", b"1e-400", b"9007199254740993", b'"\\u0000"', b"[null]", b'{"":{}}',
    b'{"vertex":0,"position":[0,0,0]}', b'{"vertex":"","position":["","",""]}', b"{\"name\":\"vertices\"}",
)  # fmt: skip


@kind("JSON: the list that the call takes, with very many elements")
def many_right_elements(rng: Rng, world: World) -> Request:
    """Long lists of valid elements, which pass the first checks."""
    model = world.quick(rng)
    found = calls(model, rng)
    code = json.dumps(model.code(rng)).encode()
    numbers, wrong = pick(rng, b"0", b"0.5", b"1e9", b"-0.0"), pick(rng, b'""', b"null", b"{}", b"[]", b"[[]]", b"true")
    element = {
        "mesh latent": numbers, "edit latent": numbers, "vertices latents": code, "nric latents": code,
        "interpolations keyframes": code, "interpolations times": numbers, "encode vertices": b"[0,0,0]",
        "encode faces": b"[0,0,0]", "edit targets": b'{"vertex":0,"position":[0,0,0]}',
        "infer outputs": b'{"name":"nric"}',
    }  # fmt: skip
    place = pick(rng, *element)
    call, member = place.split()
    target, body = found[call]
    text = repeated(element[place] if rng.random() < 0.5 else wrong, size(rng) - 300)
    return post(target, spliced(body, member, text))


@kind("JSON: infer with very much data")
def much_data(rng: Rng, world: World) -> Request:
    model = world.quick(rng)
    target, body = calls(model, rng)["infer"]
    code = json.dumps(model.code(rng)).encode()
    text = repeated(pick(rng, b"0", b"0.25", b'""', b"[0]", b"null", b"[]", code, b"[[0]]"), size(rng) - 300)
    count = int(rng.integers(1, 10**7))
    tensor = {**body["inputs"][0], "shape": [count, model.dimension]}
    inner = spliced(tensor, "data", text)
    return post(target, spliced(body, "inputs", b"[" + inner + b"]"))


def grown(name: str) -> Callable[[Callable[[Rng, int], bytes]], Callable[[Rng, int], bytes]]:
    """A decorator that adds a kind: the generated text of some size is one member of a body, or the body."""

    def enter(text: Callable[[Rng, int], bytes]) -> Callable[[Rng, int], bytes]:
        @kind(f"JSON: {name}")
        def make(rng: Rng, world: World) -> Request:
            target, body = a_call(world, rng)
            long = text(rng, size(rng) - 300)
            return post(target, long if rng.random() < 0.3 else spliced(body, a_member(rng, body), long))

        return text

    return enter


@grown("a member with very many elements")
def many_elements(rng: Rng, most: int) -> bytes:
    return repeated(pick(rng, *ELEMENTS), most)


@grown("depth")
def deep(rng: Rng, most: int) -> bytes:
    open, close = pick(rng, (b"[", b"]"), (b'{"a":', b"}"), (b'[{"latent":', b"}]"), (b'{"inputs":[', b"]}"))
    count = most // (len(open) + len(close))
    return bytes(open * count + b"0" + (close * count if rng.random() < 0.7 else b""))


@grown("very many members")
def many_members(rng: Rng, most: int) -> bytes:
    value = pick(rng, b"0", b"[]", b'""', b"{}")
    if rng.random() < 0.5:
        return repeated(pick(rng, b'"x":', b'"latent":', b'"inputs":') + value, most, b"{", b"}")
    return b"{" + b",".join(b'"%x":' % k + value for k in range(most // (9 + len(value)))) + b"}"


@grown("numbers of a million digits")
def long_numbers(rng: Rng, most: int) -> bytes:
    digits = pick(rng, b"1", b"9", b"0") * min(most, 2 * 10**6)
    number = pick(rng, digits, b"1" + digits, b"-1" + digits, b"0." + digits, b"1e" + digits, b"1e-" + digits,
                  b"1." + digits + b"e5", b"1" + digits + b".0")  # fmt: skip
    return bytes(pick(rng, number, repeated(number[: len(number) // 3 + 2], most)))


@grown("long strings")
def long_strings(rng: Rng, most: int) -> bytes:
    unit = pick(rng, b"a", b"\\u00e9", b"\\ud800", b"\\ud83d\\ude00", b"\\n", b"\\\\", "é".encode(), "🔺".encode(),
                b"\\u0000", b"\xff", b"\xed\xa0\x80", b"%s", b"\x01")  # fmt: skip
    text = b'"' + unit * (most // len(unit)) + pick(rng, b'"', b"", b"\\")
    return b"{" + text + b":0}" if rng.random() < 0.3 else text


@kind("JSON: other encodings, marks and spaces")
def other_text(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    text, most = json.dumps(body), size(rng) - 300
    space = pick(rng, " ", "\n", "\t", "\r\n", "\u00a0", "\ufeff")
    long = pick(rng, space * most + text, text + space * most, text[:1] + space * most + text[1:])[:most]
    name = pick(rng, "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "utf-16-be")
    content = long.encode(name)[:BODY]
    return post(target, content, {"Content-Type": f"application/json; charset={name}"})


@kind("JSON: cut off, or with more behind it")
def cut_off(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    whole = spliced(body, a_member(rng, body), repeated(pick(rng, *ELEMENTS), size(rng) - 300))
    cut = whole[: int(rng.integers(len(whole)))]
    return post(target, pick(rng, cut, whole + b"}", (whole + b"\n") * max(1, BODY // 2 // len(whole)))[:BODY])


@kind("JSON: over the limit")
def over_the_limit(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    content = b" " * (BODY + int(rng.integers(1, 4 * MIB)))
    if rng.random() < 0.5:
        return Request([head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"}), *chunks(content, 2**16)])
    return post(target, content)


@kind("JSON: noise")
def noise(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    return post(target, rng.bytes(size(rng)))
