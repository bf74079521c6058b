"""What pytest and its notebooks need of the machine, set before anything is imported.

The kernels that nbval starts inherit this environment. A variable that the user has
set already is left alone.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path


def mujoco_imports_with_egl():
    """True if MuJoCo can draw off screen: with a broken EGL its very import fails."""
    probe = [sys.executable, "-c", "import mujoco.egl"]
    environment = os.environ | {"MUJOCO_GL": "egl"}
    return not subprocess.run(probe, env=environment, capture_output=True).returncode


os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # pygame draws into memory
if sys.platform == "linux" and "MUJOCO_GL" not in os.environ:
    if mujoco_imports_with_egl():
        os.environ["MUJOCO_GL"] = "egl"

if not os.access(Path.home(), os.W_OK):  # their warnings would fail the first cell
    _home = tempfile.TemporaryDirectory(prefix="dnddpg-home-")  # gone when pytest ends
    for name in ("MPLCONFIGDIR", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
        os.environ.setdefault(name, _home.name)


def pytest_configure(config):
    # The kernel is this Python, even where a kernel of the same name is installed.
    config.option.nbval_current_env = True
