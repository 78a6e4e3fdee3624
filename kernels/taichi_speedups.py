"""Functions inside Taichi 1.7.4 replaced by faster ones of the same meaning, for a shorter cold start.

They change Taichi for the whole process, so only `edslam_ti.cold_start` applies them, for the command line.
Code of others that uses Taichi in the same process works as before. With another version or another engine
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
    # At every expression of a kernel that is compiled, Taichi wrapped a source line for an error message.
    ASTTransformerContext.get_pos_info = _position_in_source
    # It searched and wrapped the source of a function once for each call of it in a kernel.
    kernel_impl.getsourcelines = functools.cache(kernel_impl.getsourcelines)
    kernel_impl.textwrap = SimpleNamespace(dedent=textwrap.dedent, fill=functools.cache(textwrap.fill))
    # It asked numpy for the range of integers at every literal.
    taichi.lang.expr.np = SimpleNamespace(**vars(np) | {"iinfo": functools.cache(np.iinfo)})
    # To see whether a kernel is a method, it read the calling line by way of a search through all modules.
    kernel_impl.inspect = SimpleNamespace(**vars(inspect) | {"getframeinfo": _frame_information})
    # At every launch, it looked for torch and for the name of the dtype of each array.
    kernel_impl.has_pytorch = functools.cache(kernel_impl.has_pytorch)
    kernel_impl.to_taichi_type = functools.cache(kernel_impl.to_taichi_type)
    return True


def _position_in_source(self: Any, node: ast.expr | ast.stmt) -> str:
    """Return where in a source file a kernel does not compile."""
    line = node.lineno + self.lineno_offset
    return f'File "{self.file}", line {line}, in {self.func.func.__name__}:\n{self.src[node.lineno - 1]}\n'


def _frame_information(frame: FrameType) -> tuple[str, int, str, list[str] | None, int]:
    """Return what `inspect.getframeinfo` does; the source line is read by the name of its file."""
    code, line = frame.f_code, linecache.getline(frame.f_code.co_filename, frame.f_lineno, frame.f_globals)
    return code.co_filename, frame.f_lineno, code.co_name, [line] if line else None, 0
