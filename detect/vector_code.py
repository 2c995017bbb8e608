"""What operations on numbers beside each other are written with, in the compiler's own vectors.

They are given to LLVM as operations on vectors, which it turns into whatever the processor has;
they are called from compiled code only, and check nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

#: Numbers of single precision in one vector: a register with AVX2.
LANES = 8
#: Pixels that are read at once for each of them.
WORD = 8

I8, I16, I32, I64 = (ir.IntType(bits) for bits in (8, 16, 32, 64))
FLOAT = ir.FloatType()
BYTES = ir.VectorType(I8, LANES)
SHORTS = ir.VectorType(I16, LANES)
INTS = ir.VectorType(I32, LANES)
LONGS = ir.VectorType(I64, LANES)
FLOATS = ir.VectorType(FLOAT, LANES)
# Products and sums may become one instruction.
_FLAGS = ("contract",)


def operation(define: Callable[..., Any]) -> Any:
    """An operation that compiled code can call: without the first argument of its definition."""
    return intrinsic(define)


def constant(vector: Any, value: Any) -> Any:
    """A vector of equal constants."""
    return ir.Constant(vector, [value] * vector.count)


class Code:
    """Builder of an operation: its arguments, and instructions."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.builder = builder
        self.data = [
            context.make_array(kind)(context, builder, value).data
            if isinstance(kind, types.Array)
            else value
            for kind, value in zip(signature.args, args)
        ]

    def load(self, argument: int, index: Any, kind: Any) -> Any:
        """A number, or as many as a vector holds, from an index of a contiguous array on."""
        return self.load_from(self.data[argument], index, kind)

    def load_from(self, begin: Any, index: Any, kind: Any) -> Any:
        """As `load`, from a pointer to an element on."""
        value = self.builder.load(self._behind(begin, index, kind))
        value.align = 4 if getattr(kind, "element", kind) == FLOAT else 1
        return value

    def pointers(self, argument: int, indices: Any, begin: Any = None) -> list[Any]:
        """Pointers to elements of an array; indices are a vector of 32 bit, from `begin` on."""
        first = self.data[argument]
        if begin is not None:
            first = self.builder.gep(first, [begin])
        longs = ir.VectorType(I64, indices.type.count)
        size = {I8: 1, FLOAT: 4}[first.type.pointee]
        behind = self.builder.mul(self.builder.sext(indices, longs), constant(longs, size))
        places = self.builder.add(self.everywhere(self.builder.ptrtoint(first, I64), longs), behind)
        return [self.builder.inttoptr(place, first.type) for place in self.scattered(places)]

    def store(self, argument: int, index: Any, value: Any) -> None:
        self.builder.store(value, self._place(argument, index, value.type)).align = 4

    def prefetch(self, argument: int, index: Any) -> None:
        """Fetch a line of the cache that will be needed soon; it may lie outside the array."""
        place = I8.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [place, I32, I32, I32])
        fetch = self.builder.module.declare_intrinsic("llvm.prefetch", [place], kind)
        where = self.builder.bitcast(self.builder.gep(self.data[argument], [index]), place)
        # To be read, and again, as data.
        self.builder.call(fetch, [where, *(ir.Constant(I32, value) for value in (0, 3, 1))])

    def _place(self, argument: int, index: Any, kind: Any) -> Any:
        return self._behind(self.data[argument], index, kind)

    def _behind(self, begin: Any, index: Any, kind: Any) -> Any:
        where = self.builder.gep(begin, [index])
        return self.builder.bitcast(where, kind.as_pointer())

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b, flags=_FLAGS)

    def sub(self, a: Any, b: Any) -> Any:
        return self.builder.fsub(a, b, flags=_FLAGS)

    def mul(self, a: Any, b: Any) -> Any:
        return self.builder.fmul(a, b, flags=_FLAGS)

    def divide(self, a: Any, b: Any) -> Any:
        return self.builder.fdiv(a, b, flags=_FLAGS)

    def everywhere(self, value: Any, vector: Any = FLOATS) -> Any:
        """A vector of equal numbers."""
        first = self.builder.insert_element(
            ir.Constant(vector, ir.Undefined), value, ir.Constant(I32, 0)
        )
        order = constant(ir.VectorType(I32, vector.count), 0)
        return self.builder.shuffle_vector(first, first, order)

    def gathered(self, numbers: list[Any]) -> Any:
        """A vector of these numbers."""
        vector = ir.Constant(ir.VectorType(numbers[0].type, len(numbers)), ir.Undefined)
        for k, number in enumerate(numbers):
            vector = self.builder.insert_element(vector, number, ir.Constant(I32, k))
        return vector

    def scattered(self, vector: Any) -> list[Any]:
        """The numbers of a vector."""
        places = (ir.Constant(I32, k) for k in range(vector.type.count))
        return [self.builder.extract_element(vector, place) for place in places]

    def grey_from(self, begin: Any, index: Any) -> Any:
        """Neighbouring grey values, counted from 128, from a pointer to a pixel on."""
        values = self.load_from(begin, index, BYTES)
        # x - 128 is x with its highest bit turned over, as a signed number.
        values = self.builder.xor(values, constant(BYTES, 0x80))
        return self.builder.sitofp(self.builder.sext(values, INTS), FLOATS)

    def shuffled(self, first: Any, second: Any, order: list[int]) -> Any:
        """Numbers of two vectors, counted through, in some order."""
        chosen = ir.Constant(ir.VectorType(I32, len(order)), order)
        return self.builder.shuffle_vector(first, second, chosen)

    def magnitude(self, value: Any) -> Any:
        """Numbers without their signs."""
        ints = ir.VectorType(I32, value.type.count)
        bits = self.builder.bitcast(value, ints)
        bits = self.builder.and_(bits, constant(ints, 0x7FFFFFFF))
        return self.builder.bitcast(bits, value.type)

    def zeros(self, vector: Any = FLOATS) -> Any:
        """A vector that is summed up; LLVM keeps it in registers."""
        return cgutils.alloca_once_value(self.builder, constant(vector, 0.0))

    def increase(self, variable: Any, value: Any) -> None:
        self.builder.store(self.add(self.builder.load(variable), value), variable)

    def within(self, x: Any, left: Any, right: Any) -> Any:
        """Which numbers lie in [left, right); NaN does not."""
        return self.builder.and_(
            self.builder.fcmp_ordered(">=", x, self.everywhere(left, x.type)),
            self.builder.fcmp_ordered("<", x, self.everywhere(right, x.type)),
        )

    def only(self, where: Any, value: Any) -> Any:
        """Numbers, and 0 elsewhere."""
        return self.builder.select(where, value, constant(value.type, 0.0))

    def number(self, value: int) -> Any:
        return ir.Constant(I64, value)
