"""Sixteen numbers as one value inside numba kernels.

LLVM does not make vector code of loops over small slices (it cannot know that arrays do not
overlap), so the kernels say it: `load`, `splat`, + - * / (also with a number), `store`, for float32
and float64. On AVX-512 sixteen float32 are one register; elsewhere LLVM splits them, so the kernels
run, slower, on any processor. A product that feeds a sum becomes one fused instruction where there
is one.
"""

from __future__ import annotations

import operator
from math import factorial

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.datamodel import models
from numba.extending import intrinsic, overload, register_model
from numba.np.arrayobj import make_array

from isac_rt.kernels.jit import AVX512, FAST, jit

LANES = 16
PART = LANES if AVX512 else LANES // 2
"""Lanes that kernels with many values take at once (`load_part`): half of them where sixteen
registers hold eight float32 each, for what does not fit there goes to memory and back. Which it is
changes no bit: lanes know nothing of each other."""


class _Vector(types.Type):
    """Some of `element`."""

    def __init__(self, element: types.Float, lanes: int = LANES) -> None:
        self.element = element
        self.form = ir.VectorType(
            {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}[element], lanes
        )
        super().__init__(name=f"{element}x{lanes}")


FLOATS, DOUBLES = _Vector(types.float32), _Vector(types.float64)


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:
        super().__init__(manager, kind, kind.form)


def _address(context, builder, kind, array, index, form):
    data = make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), form.as_pointer())


def _size(kind) -> int:
    return kind.dtype.bitwidth // 8


def _mask(indices):
    indices = list(indices)
    return ir.Constant(ir.VectorType(ir.IntType(32), len(indices)), indices)


def _loading(lanes):
    """Intrinsic of a flat array and an index: so many elements from there."""

    @intrinsic
    def loaded(typingctx, array, index):
        def codegen(context, builder, signature, args):
            kind, form = signature.args[0], signature.return_type.form
            at = _address(context, builder, kind, *args, form)
            return builder.load(at, align=_size(kind))

        return _Vector(array.dtype, lanes)(array, types.intp), codegen

    return loaded


load, load_part = _loading(LANES), _loading(PART)


@intrinsic
def store(typingctx, array, index, value):
    """Write a vector to a flat array from `index`."""

    def codegen(context, builder, signature, args):
        kind = signature.args[0]
        at = _address(context, builder, kind, *args[:2], args[2].type)
        builder.store(args[2], at, align=_size(kind))
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def stream(typingctx, array, index, value):
    """`store` past the caches, to an address that is a multiple of 64."""

    def codegen(context, builder, signature, args):
        written = builder.store(
            args[2],
            _address(context, builder, signature.args[0], *args[:2], args[2].type),
            align=64,
        )
        written.set_metadata(
            "nontemporal", builder.module.add_metadata([ir.Constant(ir.IntType(32), 1)])
        )
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


def _repeated(builder, value, form):
    nothing = ir.Constant(form, ir.Undefined)
    first = builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, nothing, _mask([0] * form.count))


def _splatting(lanes):
    """Intrinsic: the same number in so many lanes."""

    @intrinsic
    def splatted(typingctx, value):
        def codegen(context, builder, signature, args):
            return _repeated(builder, args[0], signature.return_type.form)

        return _Vector(value, lanes)(value), codegen

    return splatted


splat, splat_part = _splatting(LANES), _splatting(PART)


@intrinsic
def narrow(typingctx, value):
    """Float64 to float32, lane by lane."""

    def codegen(context, builder, signature, args):
        return builder.fptrunc(args[0], FLOATS.form)

    return FLOATS(DOUBLES), codegen


def _each(name):
    """Intrinsic of LLVM's own function of every lane."""

    @intrinsic
    def made(typingctx, value):
        def codegen(context, builder, signature, args):
            kind, module = signature.args[0], builder.module
            whole = f"llvm.{name}.v{kind.form.count}f{kind.element.bitwidth}"
            function = module.globals.get(whole) or ir.Function(
                module, ir.FunctionType(kind.form, [kind.form]), whole
            )
            return builder.call(function, args)

        return value(value), codegen

    return made


floor, root = _each("floor"), _each("sqrt")


def _two(method):
    """Intrinsic of two vectors: `method(builder, a, b)`."""

    @intrinsic
    def both(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return method(builder, *args)

        return a(a, a), codegen

    return both


larger = _two(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b))
# 1 in lanes that are not above the other's, else 0
not_above = _two(
    lambda builder, a, b: builder.select(
        builder.fcmp_ordered("<=", a, b),
        ir.Constant(a.type, [1.0] * LANES),
        ir.Constant(a.type, [0.0] * LANES),
    )
)


def _zipped(start):
    """Intrinsic of two vectors: lanes in turn, from the share `start` of them on."""

    def method(builder, a, b):
        lanes = a.type.count
        first = int(start * lanes)
        return builder.shuffle_vector(
            a, b, _mask(first + i // 2 + lanes * (i % 2) for i in range(lanes))
        )

    return _two(method)


zip_low, zip_high = _zipped(0), _zipped(0.5)

evens = _two(lambda builder, a, b: builder.shuffle_vector(a, b, _mask(range(0, 2 * LANES, 2))))
odds = _two(lambda builder, a, b: builder.shuffle_vector(a, b, _mask(range(1, 2 * LANES, 2))))


@intrinsic
def backwards(typingctx, value):
    """The last lane first."""

    def codegen(context, builder, signature, args):
        nothing = ir.Constant(args[0].type, ir.Undefined)
        return builder.shuffle_vector(args[0], nothing, _mask(range(args[0].type.count)[::-1]))

    return value(value), codegen


@intrinsic
def _all(typingctx, value, like):
    """The same number in all lanes of a vector like another."""

    def codegen(context, builder, signature, args):
        return _repeated(builder, args[0], signature.return_type.form)

    return like(value, like), codegen


def _let(sign, of_two):
    """Let kernels write `sign` between two vectors, or a vector and a number."""

    @overload(sign)
    def made(a, b):
        if isinstance(a, _Vector) and a == b:
            return lambda a, b: of_two(a, b)
        if isinstance(a, _Vector) and b == a.element:
            return lambda a, b: of_two(a, _all(b, a))
        if isinstance(b, _Vector) and a == b.element:
            return lambda a, b: of_two(_all(a, b), b)
        return None


_let(operator.add, _two(lambda builder, a, b: builder.fadd(a, b, flags=FAST)))
_let(operator.sub, _two(lambda builder, a, b: builder.fsub(a, b, flags=FAST)))
_let(operator.mul, _two(lambda builder, a, b: builder.fmul(a, b, flags=FAST)))
_let(operator.truediv, _two(lambda builder, a, b: builder.fdiv(a, b, flags=FAST)))


def _transposed(builder, rows):
    """As many vectors as each has lanes: rounds of exchanges between rows i and i + s."""
    rows, size = list(rows), len(rows)
    for s in (2**k for k in range(size.bit_length() - 1)):
        upper = _mask(lane if not lane & s else lane - s + size for lane in range(size))
        lower = _mask(lane + s if not lane & s else lane + size for lane in range(size))
        for i in range(size):
            if not i & s:
                a, b = rows[i], rows[i + s]
                rows[i] = builder.shuffle_vector(a, b, upper)
                rows[i + s] = builder.shuffle_vector(a, b, lower)
    return rows


@intrinsic
def transpose(typingctx, array, index):
    """Transpose in place the 16 x 16 float32 that lie from `index`, square by square of `PART` rows
    and columns."""

    def codegen(context, builder, signature, args):
        kind, form = signature.args[0], _Vector(types.float32, PART).form

        def square(row, column):
            starts = [LANES * (row + i) + column for i in range(PART)]
            addresses = [builder.add(args[1], ir.Constant(args[1].type, start)) for start in starts]
            return [_address(context, builder, kind, args[0], at, form) for at in addresses]

        for row in range(0, LANES, PART):
            for column in range(0, row + 1, PART):
                squares = [square(row, column), square(column, row)][: 1 + (row > column)]
                turned = [
                    _transposed(builder, [builder.load(at, align=4) for at in addresses])
                    for addresses in squares
                ]
                for addresses, rows in zip(reversed(squares), turned, strict=True):
                    for at, value in zip(addresses, rows, strict=True):
                        builder.store(value, at, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


_PI = np.float32(np.pi)
_TWO = np.float32(2)
# Taylor series about 0 up to where the next term is below an ulp at a quarter turn
_SIN = tuple(np.float32(c) for c in (1, -1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800))
_COS = tuple(
    np.float32(c) for c in (1, -1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800, 1 / 479001600)
)
# The same for float64
_SINE = tuple((-1.0) ** i / factorial(2 * i + 1) for i in range(11))
_COSINE = tuple((-1.0) ** i / factorial(2 * i) for i in range(11))
_SHORT_SINE, _SHORT_COSINE = _SINE[:8], _COSINE[:8]  # what is cut is below 7e-11


@jit(inline=True)
def _sum_of(series, q):
    """sum_i series[i] q^i by Horner's rule."""
    last = len(series) - 1
    value = series[last - 1] + q * series[last]
    for i in range(2, last + 1):
        value = series[last - i] + q * value
    return value


@jit(inline=True)
def cos_sin(cycles):
    """Cosine and sine of 2 pi `cycles` (float32, within [-0.55, 0.55]) by the series of half the
    angle; errors below 1.3e-6."""
    h = cycles * _PI
    q = h * h
    s, c = h * _sum_of(_SIN, q), _sum_of(_COS, q)
    twice = _TWO * s
    return _COS[0] - twice * s, twice * c


@jit(inline=True)
def cos_sin_exact(cycles):
    """Cosine and sine of 2 pi `cycles` (float64, within [-0.5, 0.5]) to 1e-10, as float32."""
    h = cycles * np.pi
    q = h * h
    s, c = h * _sum_of(_SHORT_SINE, q), _sum_of(_SHORT_COSINE, q)
    twice = 2.0 * s
    return narrow(1.0 - twice * s), narrow(twice * c)


@jit(inline=True)
def cos_sin_double(cycles):
    """Cosine and sine of 2 pi `cycles` (float64, within [-0.5, 0.5]) to some 1e-16."""
    h = cycles * np.pi
    q = h * h
    s, c = h * _sum_of(_SINE, q), _sum_of(_COSINE, q)
    twice = 2.0 * s
    return 1.0 - twice * s, twice * c


def unset(size: int) -> np.ndarray:
    """Float32 (size,) of any values from an address that is a multiple of 64: a vector that crosses
    a cache line costs twice."""
    buffer = np.empty(4 * size + 64, np.uint8)
    start = -buffer.ctypes.data % 64
    return buffer[start : start + 4 * size].view(np.float32)


def aligned(size: int) -> np.ndarray:
    """`unset`, all zeros."""
    out = unset(size)
    out[:] = 0
    return out


def new_memory(shape: tuple[int, ...]) -> np.ndarray:
    """Complex64 of any values from an address that is a multiple of 64."""
    return unset(2 * int(np.prod(shape))).view(np.complex64).reshape(shape)
