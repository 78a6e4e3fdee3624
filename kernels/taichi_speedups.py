"""Replaces functions inside Taichi 1.7.4 by faster, equivalent ones, for a shorter cold start.

They change Taichi for the whole process, so only `edslam_ti.cold_start` applies them, for the command line.
Other code that uses Taichi in the same process works as before. With another version or another engine
nothing is replaced. The environment variable EDSLAM_PLAIN_TAICHI=1 switches the replacements off.
"""

import ast
import functools
import inspect
import linecache
import os
import textwrap
from types import FrameType, SimpleNamespace
from typing import Any

import numpy as np

from edslam_ti.kernels.engine import ENGINE, VERSION

SWITCH = "EDSLAM_PLAIN_TAICHI"


def apply() -> bool:
    """Replace the functions, and return whether they now are replaced."""
    if os.environ.get(SWITCH, "0") not in ("", "0") or (ENGINE, VERSION) != ("taichi", "1.7.4"):
        return False
    import taichi.lang.expr
    import taichi.lang.matrix_ops  # Taichi imports it with its first vector, where that takes longer
    from taichi.lang import kernel_impl
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

    if ASTTransformerContext.get_pos_info is _position_in_source:
        return True
    # Taichi wrapped a source line for an error message at every expression that it compiled.
    ASTTransformerContext.get_pos_info = _position_in_source
    # It read and wrapped a function's source once for each call of the function in a kernel.
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
    kernel_impl.textwrap = SimpleNamespace(dedent=textwrap.dedent, fill=functools.cache(textwrap.fill))
    # It asked numpy for the range of integers at every literal.
    taichi.lang.expr.np = SimpleNamespace(**vars(np) | {"iinfo": functools.cache(np.iinfo)})
    # To find out whether a kernel is a method, it searched all modules for the calling line.
    kernel_impl.inspect = SimpleNamespace(**vars(inspect) | {"getframeinfo": _frame_information})
    # At every launch it looked up torch and the name of each array's dtype.
    kernel_impl.has_pytorch = functools.cache(kernel_impl.has_pytorch)
    kernel_impl.to_taichi_type = functools.cache(kernel_impl.to_taichi_type)
    return True


def _position_in_source(self: Any, node: ast.expr | ast.stmt) -> str:
    """Return the place in a source file where a kernel does not compile."""
    line = node.lineno + self.lineno_offset
    return f'File "{self.file}", line {line}, in {self.func.func.__name__}:\n{self.src[node.lineno - 1]}\n'


def _frame_information(frame: FrameType) -> tuple[str, int, str, list[str] | None, int]:
    """Return the result of `inspect.getframeinfo`, but read the source line by its file name."""
    code, line = frame.f_code, linecache.getline(frame.f_code.co_filename, frame.f_lineno, frame.f_globals)
    return code.co_filename, frame.f_lineno, code.co_name, [line] if line else None, 0
