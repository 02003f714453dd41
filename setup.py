"""Build the compiled kernel, where that is possible; everything else is in pyproject.toml.

The kernel is optional: without a compiler, the Python twins of its functions are used.
"""

import sysconfig

from setuptools import Extension, setup

# Free-threaded builds of Python 3.13 and 3.14 have no stable ABI.
stable = not sysconfig.get_config_var("Py_GIL_DISABLED")

setup(
    ext_modules=[
        Extension(
            "rlightning_aio.protocol._kernel",
            ["src/rlightning_aio/protocol/_kernel.c"],
            extra_compile_args=["-std=c11"],
            py_limited_api=stable,
            optional=True,
        )
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}} if stable else {},
)
