"""Vectors in structure-of-arrays storage: ``[3, count]``, one row per component."""

from typing import Any

import warp as wp

# For native code: row(q, component) points to a row of an array, whose rows may have gaps between them. Each has less
# than 2^31 bytes, but two of them together may have more.
ROW = """
    auto row = [](auto& q, size_t component) { return (decltype(q.data))((char*)q.data + component * q.strides[0]); };
"""
# For native code: each(begin, end, body) calls body(i) for i = begin, begin + lanes ... before end, in any order. Where
# lanes is 1, as on a CPU, it does so in vector instructions: whole ones first, and the rest in one that is masked, if
# the processor has such.
EACH = """
    auto each = [=](int begin, int end, auto body) {
        if (lanes > 1) {
            for (int i = begin; i < end; i += lanes) body(i);
            return;
        }
        const int whole = begin + ((end - begin) & ~7);
        #pragma clang loop vectorize(assume_safety) interleave_count(1)
        for (int i = begin; i < whole; ++i) body(i);
        const int rest = end - whole;
        if (rest == 0) return;
        #if defined(__AVX__) || defined(__ARM_FEATURE_SVE)
        #pragma clang loop vectorize(assume_safety) interleave_count(1)
        #endif
        for (int k = 0; k < 8; ++k) if (k < rest) body(whole + k);
    };
"""


@wp.func
def load(q: wp.array2d(dtype=Any), i: int):
    """Return column i of q."""
    return wp.vector(q[0, i], q[1, i], q[2, i])


@wp.func
def store(q: wp.array2d(dtype=Any), i: int, value: Any):
    """Overwrite column i of q."""
    q[0, i] = value[0]
    q[1, i] = value[1]
    q[2, i] = value[2]


@wp.func
def add(q: wp.array2d(dtype=Any), i: int, value: Any):
    """Add to column i of q, atomically."""
    wp.atomic_add(q, 0, i, value[0])
    wp.atomic_add(q, 1, i, value[1])
    wp.atomic_add(q, 2, i, value[2])
