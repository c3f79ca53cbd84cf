"""Two more operations on the lanes of `ops.cpu.simd`, for `cpu_pixels`: eight sums at once, and 2^v with fewer steps.

What the inner loops compare and multiply with comes from memory, as an argument of the kernel: numba's code would
otherwise build each constant anew for every row of pixels, about a third of its instructions.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.extending import intrinsic

from dpcli.ops.cpu.simd import _EXP2, _FLAGS, _FLOATS, _INTS, WIDTH, _is_vector, _lanes_type, _place

_ROUND = 1.5 * 2**23 + 127  # added to a small v, it leaves the nearest integer plus 127 in the lowest bits


def constants(*more: float) -> np.ndarray:
    """Returns the argument `table` of kernels that call `power`: its constants, then `more`, each eight times; float32."""
    return np.repeat(np.float32([-126, _ROUND, 0, *_EXP2, *more]), WIDTH)


OWN = 3 + len(_EXP2)  # constants before `more`


@intrinsic
def power(typingctx, table, value):
    """Returns 2^v as `simd.power_of_two`, with its numbers from `constants`; v below -126 counts as that, above 127 not."""
    if not _is_vector(table):
        return None

    def codegen(context, builder, signature, args):
        def constant(i: int) -> ir.Value:
            place = ir.Constant(ir.IntType(64), i * WIDTH)
            return builder.load(_place(context, builder, signature.args[0], args[0], place), align=4)

        least, turn = constant(0), constant(1)
        v = builder.select(builder.fcmp_ordered(">", args[1], least), args[1], least)
        turned = builder.fadd(v, turn)
        # that 0 comes from memory keeps from the compiler, allowed to reorder, that adding and subtracting cancel
        bits = builder.xor(builder.bitcast(turned, _INTS), builder.bitcast(constant(2), _INTS))
        x = builder.fsub(v, builder.fsub(builder.bitcast(bits, _FLOATS), turn))
        terms = [constant(3 + i) for i in range(len(_EXP2))]
        while len(terms) > 1:  # Estrin's scheme
            low, high = terms[::2], terms[1::2]
            joined = [builder.fadd(builder.fmul(b, x, flags=_FLAGS), a, flags=_FLAGS) for a, b in zip(low, high)]
            terms = joined + low[len(high) :]
            x = builder.fmul(x, x, flags=_FLAGS)
        exponent = builder.shl(bits, ir.Constant(_INTS, [23] * WIDTH))
        return builder.fmul(terms[0], builder.bitcast(exponent, _FLOATS))

    return _lanes_type(table, _lanes_type), codegen


def _pairs(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, low: list[int], high: list[int]) -> ir.Value:
    parts = [builder.shuffle_vector(a, b, ir.Constant(_INTS, places)) for places in (low, high)]
    return builder.fadd(*parts, flags=_FLAGS)


@intrinsic
def totals(typingctx, a, b, c, d, e, f, g, h):
    """Returns a vector whose lane i is the sum of the i-th argument's lanes, always added in the same order."""
    even, odd = [0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]  # each within halves of a register
    left, right = [0, 1, 2, 3, 8, 9, 10, 11], [4, 5, 6, 7, 12, 13, 14, 15]

    def codegen(context, builder, signature, args):
        while len(args) > 2:
            args = [_pairs(builder, x, y, even, odd) for x, y in zip(args[::2], args[1::2], strict=True)]
        return _pairs(builder, *args, left, right)

    return _lanes_type(*[_lanes_type] * WIDTH), codegen
