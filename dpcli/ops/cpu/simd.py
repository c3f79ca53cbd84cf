"""Eight float32 lanes as one value inside numba kernels: arithmetic that is vector code by construction.

Numba's loops become vector code only where LLVM proves that no two arrays overlap, which it can't in a kernel that
reads and writes many; a value of type `lanes` needs no such proof. LLVM maps it to the machine's registers: one on
AVX, two on SSE or NEON. The kernels' cache takes note of changes to this file (`jit.SHARED_CODE`).

In a kernel: `lanes(x)` repeats a scalar, `load(array, i)` and `store(array, i, v)` move 8 values of a C-contiguous
float32 vector from element i, `ramp()` is 0..7, `+ - *` are elementwise (multiply-add may contract), `lower(a, b)` and
`higher(a, b)` are min and max, `where_lower(a, b, x, y)` is x where a < b and y elsewhere, `reciprocal(v)` is 1/v,
`power_of_two(v)` is 2^v, `total(v)` sums the lanes, always in the same order, `any_lower(a, b)` is whether a < b in
any lane. `claim(counter)` counts element 0 of an int64 vector up, once for each thread that asks, and returns what it was.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing import signature as typing_signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH = 8

_FLOATS = ir.VectorType(ir.FloatType(), WIDTH)
_INTS = ir.VectorType(ir.IntType(32), WIDTH)
_FLAGS = ("contract", "nsz", "arcp", "nnan")
# Remez, relative error 7.7e-8 on -0.5..0.5; in float32 arithmetic 2^v is within 3e-7 (tested).
_EXP2 = (1.00000007, 0.693146968, 0.240221143, 0.055507096, 0.00967575764, 0.00132779389)


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name="float32x8")


_lanes_type = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, fe_type) -> None:
        super().__init__(manager, fe_type, _FLOATS)


def _vector(builder: ir.IRBuilder, scalar: ir.Value) -> ir.Value:
    one = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, one, ir.Constant(_INTS, [0] * WIDTH))


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_FLOATS, [value] * WIDTH)


def _place(context, builder: ir.IRBuilder, array_type, array: ir.Value, index: ir.Value) -> ir.Value:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(cgutils.gep(builder, data, index), _FLOATS.as_pointer())


def _is_vector(array) -> bool:
    return isinstance(array, types.Array) and array.ndim == 1 and array.dtype == types.float32 and array.layout == "C"


@intrinsic
def lanes(typingctx, scalar):
    """Repeats a scalar in eight lanes."""

    def codegen(context, builder, signature, args):
        return _vector(builder, args[0])

    return _lanes_type(types.float32), codegen


@intrinsic
def ramp(typingctx):
    """Returns the lanes 0..7."""

    def codegen(context, builder, signature, args):
        return ir.Constant(_FLOATS, [float(lane) for lane in range(WIDTH)])

    return _lanes_type(), codegen


@intrinsic
def load(typingctx, array, index):
    """Reads eight values of a C-contiguous float32 vector from element `index` on."""

    if not _is_vector(array):
        return None

    def codegen(context, builder, signature, args):
        return builder.load(_place(context, builder, signature.args[0], *args), align=4)

    return _lanes_type(array, types.uintp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """Writes eight values into a C-contiguous float32 vector from element `index` on."""

    if not _is_vector(array):
        return None

    def codegen(context, builder, signature, args):
        builder.store(args[2], _place(context, builder, signature.args[0], *args[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.uintp, _lanes_type), codegen


def _binary(emit):
    @intrinsic
    def function(typingctx, a, b):
        def codegen(context, builder, signature, args):
            return emit(builder, *args)

        return _lanes_type(_lanes_type, _lanes_type), codegen

    return function


def _lower(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _higher(builder: ir.IRBuilder, a: ir.Value, b: ir.Value) -> ir.Value:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


lower, higher = _binary(_lower), _binary(_higher)


def _operator(symbol, method: str) -> None:
    @infer_global(symbol)
    class Typing(AbstractTemplate):
        def generic(self, args, kws):
            pair = len(args) == 2 and all(isinstance(arg, _Lanes) for arg in args)
            return typing_signature(_lanes_type, _lanes_type, _lanes_type) if pair else None

    @lower_builtin(symbol, _Lanes, _Lanes)
    def codegen(context, builder, signature, args):
        return getattr(builder, method)(*args, flags=_FLAGS)


for _symbol, _method in ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul")):
    _operator(_symbol, _method)


@intrinsic
def where_lower(typingctx, a, b, x, y):
    """Takes x in the lanes where a < b, y in the others."""

    def codegen(context, builder, signature, args):
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return _lanes_type(*[_lanes_type] * 4), codegen


@intrinsic
def reciprocal(typingctx, value):
    """Computes 1 / v in each lane."""

    def codegen(context, builder, signature, args):
        return builder.fdiv(_constant(1.0), args[0])

    return _lanes_type(_lanes_type), codegen


def _polynomial(builder: ir.IRBuilder, x: ir.Value, coefficients: tuple[float, ...]) -> ir.Value:
    """Evaluates a polynomial by Estrin's scheme: pairs first, so that half the multiplications don't wait for each other."""
    terms = [_constant(c) for c in coefficients]
    while len(terms) > 1:
        low, high = terms[::2], terms[1::2]
        joined = [builder.fadd(builder.fmul(b, x, flags=_FLAGS), a, flags=_FLAGS) for a, b in zip(low, high)]
        terms = joined + low[len(high) :]
        x = builder.fmul(x, x, flags=_FLAGS)
    return terms[0]


@intrinsic
def power_of_two(typingctx, value):
    """Returns 2^v for v in -126..127; what lies below counts as -126. 2^v = 2^n 2^f, n the nearest integer."""

    def codegen(context, builder, signature, args):
        v = _higher(builder, args[0], _constant(-126.0))
        floor_type = ir.FunctionType(_FLOATS, [_FLOATS])
        floor = cgutils.get_or_insert_function(builder.module, floor_type, f"llvm.floor.v{WIDTH}f32")
        whole = builder.call(floor, [builder.fadd(v, _constant(0.5))])
        rest = builder.fsub(v, whole)
        result = _polynomial(builder, rest, _EXP2)
        exponent = builder.add(builder.fptosi(whole, _INTS), ir.Constant(_INTS, [127] * WIDTH))
        bits = builder.shl(exponent, ir.Constant(_INTS, [23] * WIDTH))
        return builder.fmul(result, builder.bitcast(bits, _FLOATS))

    return _lanes_type(_lanes_type), codegen


@intrinsic
def total(typingctx, value):
    """Sums the lanes, always in the same order."""

    def codegen(context, builder, signature, args):
        v = args[0]
        for step in (4, 2, 1):
            turned = ir.Constant(_INTS, [(lane + step) % WIDTH for lane in range(WIDTH)])
            v = builder.fadd(v, builder.shuffle_vector(v, v, turned))
        return builder.extract_element(v, ir.Constant(ir.IntType(32), 0))

    return types.float32(_lanes_type), codegen


@intrinsic
def any_lower(typingctx, a, b):
    """Tells whether a < b in any lane."""

    def codegen(context, builder, signature, args):
        bits = builder.bitcast(builder.fcmp_ordered("<", *args), ir.IntType(WIDTH))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(WIDTH), 0))

    return types.boolean(_lanes_type, _lanes_type), codegen


@intrinsic
def claim(typingctx, counter):
    """Counts element 0 of an int64 vector up, once for each thread that asks, and returns what it was."""

    if not (isinstance(counter, types.Array) and counter.ndim == 1 and counter.dtype == types.int64):
        return None

    def codegen(context, builder, signature, args):
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), codegen
