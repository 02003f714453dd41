"""Build the compiled modules, where that is possible; everything else is in pyproject.toml.

They are optional: without a compiler, their twins in Python are used.
"""

import sysconfig

from setuptools import Extension, setup

# Free-threaded builds of Python 3.13 and 3.14 have no stable ABI.
stable = not sysconfig.get_config_var("Py_GIL_DISABLED")

setup(
    ext_modules=[
        Extension(
            f"rlightning_aio.{package.replace('/', '.')}.{name}",
            [f"src/rlightning_aio/{package}/{name}.c"],
            extra_compile_args=["-std=c11"],
            py_limited_api=stable,
            optional=True,
        )
        for package, name in [("protocol", "_kernel"), ("envs/mujoco", "_advance")]
    ],
    options={"bdist_wheel": {"py_limited_api": "cp311"}} if stable else {},
)
