"""Operations element by element, as expressions of C."""

from __future__ import annotations

import math

import numpy as np

from .flat import Unsupported

TYPES = {"float32": "float", "float64": "double", "int32": "int", "uint32": "unsigned", "bool": "bool",
         "int64": "long long", "uint64": "unsigned long long"}  # fmt: skip


def type_of(dtype) -> str:
    name = np.dtype(dtype).name
    if name not in TYPES:
        raise Unsupported(f"numbers of type {name}")
    return TYPES[name]


def literal(x) -> str:
    """A number as C writes it."""
    dtype = np.asarray(x).dtype
    if dtype.kind == "b":
        return "true" if x else "false"
    if dtype.kind in "iu":
        text = str(int(x)) + {"uint32": "u", "int64": "ll", "uint64": "ull"}.get(dtype.name, "")
        return f"({text})" if int(x) < 0 else text
    x = float(x)
    single = dtype == np.float32
    if math.isnan(x):
        return "(0.0f / 0.0f)" if single else "(0.0 / 0.0)"
    if math.isinf(x):
        size = "1e39" if single else "1e309"
        return f"({type_of(dtype)})({'-' if x < 0 else ''}{size})"
    text = repr(x)
    if single:  # the shortest that is this float32
        text = np.format_float_scientific(np.float32(x), unique=True)
        text = text if "." in text or "e" in text else text + "."
    text += "f" if single else ""
    return f"({text})" if x < 0 or text[0] == "-" else text


#: What every program begins with: for a GPU, and for a compiler of C++ that tests it on the CPU.
PRELUDE = """
#ifdef __CUDACC_RTC__
#define DEVICE static __device__
#define TABLE static __device__ const
__device__ __forceinline__ float larger(float a, float b) {
  float c; asm("max.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b)); return c; }
__device__ __forceinline__ float smaller(float a, float b) {
  float c; asm("min.NaN.f32 %0, %1, %2;" : "=f"(c) : "f"(a), "f"(b)); return c; }
#else
#include <cmath>
#include <cstring>
#define DEVICE static
#define TABLE static const
#define __restrict__
static inline float larger(float a, float b) { return a > b || a != a ? a : b; }
static inline float smaller(float a, float b) { return a < b || a != a ? a : b; }
static inline float rsqrtf(float x) { return 1.0f / std::sqrt(x); }
static inline double rsqrt(double x) { return 1.0 / std::sqrt(x); }
static inline int __popc(unsigned x) { return __builtin_popcount(x); }
#endif
DEVICE inline double larger(double a, double b) { return a > b || a != a ? a : b; }
DEVICE inline double smaller(double a, double b) { return a < b || a != a ? a : b; }
DEVICE inline int larger(int a, int b) { return a > b ? a : b; }
DEVICE inline int smaller(int a, int b) { return a < b ? a : b; }
DEVICE inline unsigned larger(unsigned a, unsigned b) { return a > b ? a : b; }
DEVICE inline unsigned smaller(unsigned a, unsigned b) { return a < b ? a : b; }
DEVICE inline float sign_of(float x) { return x > 0.0f ? 1.0f : x < 0.0f ? -1.0f : x; }
DEVICE inline double sign_of(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : x; }
DEVICE inline int sign_of(int x) { return x > 0 ? 1 : x < 0 ? -1 : 0; }
DEVICE inline unsigned sign_of(unsigned x) { return x > 0; }
DEVICE inline int inside(int k, int last) { return k < 0 ? 0 : k > last ? last : k; }
template <class To, class From> DEVICE inline To same_bits(From x) {
  To y; memcpy(&y, &x, sizeof(To)); return y; }
"""

_INFIX = {
    "add": "+", "sub": "-", "mul": "*", "add_any": "+", "eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">",
    "ge": ">=",
}  # fmt: skip
_FUNCTIONS = {  # of floating point numbers
    "acos", "acosh", "asin", "asinh", "atan", "atanh", "cbrt", "ceil", "cos", "cosh", "erf", "exp", "exp2", "expm1",
    "floor", "log", "log1p", "rsqrt", "sin", "sinh", "sqrt", "tan", "tanh", "atan2", "pow", "nextafter",
}  # fmt: skip


def expression(name: str, ins: list[str], dtypes, out, params) -> str | None:
    """The result of operation ``name`` for one element of every operand; None if it does not work so.

    dtypes, out: of the operands and the result.
    """
    real = dtypes and np.dtype(dtypes[0]).kind == "f"
    tail = "f" if real and np.dtype(dtypes[0]) == np.float32 else ""
    logical = np.dtype(out).kind == "b"
    a, b = (*ins, None, None)[:2]
    if name in _INFIX:
        return f"({a} {_INFIX[name]} {b})"
    if name in ("and", "or", "xor"):
        sign = {"and": "&", "or": "|", "xor": "^"}[name]
        return f"(({a}) {sign} ({b}))" if not logical else f"(bool)(({a}) {sign} ({b}))"
    if name in _FUNCTIONS and real:
        return f"{name}{tail}({', '.join(ins)})"
    unary = {"neg": f"(-{a})", "not": f"(!{a})" if logical else f"(~{a})", "sign": f"sign_of({a})",
             "square": f"({a} * {a})", "population_count": f"__popc({a})"}  # fmt: skip
    if name in unary:
        return unary[name]
    if name == "abs":
        return f"fabs{tail}({a})" if real else f"({a} < 0 ? -{a} : {a})"
    if name in ("max", "min"):
        if logical:
            return f"({a} {'||' if name == 'max' else '&&'} {b})"
        return f"{'larger' if name == 'max' else 'smaller'}({a}, {b})"
    if name == "div":
        return f"({a} / {b})"
    if name == "rem":
        return f"fmod{tail}({a}, {b})" if real else f"({a} % {b})"
    if name == "clamp":
        return f"smaller(larger({b}, {a}), {ins[2]})"
    if name == "select_n":
        if len(ins) != 3:
            raise Unsupported("select_n of more than two")
        return f"({a} ? {ins[2]} : {b})"
    if name == "integer_pow":
        return _power(a, params["y"])
    if name == "round":
        even = "EVEN" in str(params["rounding_method"]) or params["rounding_method"] == 1
        return f"{'rint' if even else 'round'}{tail}({a})"
    if name == "is_finite":
        return f"(({a} - {a}) == 0)"
    if name == "logistic":
        return f"(1 / (1 + exp{tail}(-{a})))"
    if name == "convert_element_type":
        return f"({a} != 0)" if logical else f"(({type_of(out)})({a}))"
    if name == "bitcast_convert_type":
        return f"same_bits<{type_of(out)}>({a})"
    if name in ("shift_left", "shift_right_arithmetic", "shift_right_logical"):
        if name == "shift_left":
            return f"({a} << {b})"
        kind = np.dtype(dtypes[0]).name
        want = kind if name == "shift_right_arithmetic" else "u" + kind.removeprefix("u")
        return f"(({type_of(kind)})((({type_of(want)})({a})) >> {b}))"
    return None


def _power(a: str, y: int) -> str:
    if y < 0:
        return f"(1 / {_power(a, -y)})"
    if y == 0:
        return "1"
    return "(" + " * ".join([a] * y) + ")"
