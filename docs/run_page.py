"""Run the commands of a page, and write what they print below them.

    python docs/run_page.py docs/tutorial.md            # writes the outputs anew
    python docs/run_page.py --check docs/tutorial.md    # only runs everything: an error is an exit status

Blocks of `sh` and `python` are run in order, in one empty folder. A block of `text` that follows one is
its output.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

_BLOCK = re.compile(r"```(sh|python)\n(.*?)```\n(\n```text\n.*?```\n)?", re.S)
_ROOT = Path(__file__).resolve().parent.parent
_NOISE = re.compile(r"cpu_aot_loader|xla_bridge")


def run_block(kind: str, code: str, folder: str) -> str:
    """Output of a block, standard output first; raises `SystemExit` where it fails."""
    shell = f'jaxekf() {{ "{sys.executable}" -m jaxekf "$@"; }}\nset -e\n{code}'
    command = ["bash", "-c", shell] if kind == "sh" else [sys.executable, "-c", code]
    path = os.pathsep.join([str(_ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = os.environ | {"PYTHONPATH": path, "COLUMNS": "100", "TF_CPP_MIN_LOG_LEVEL": "3"}
    env |= {"JAXEKF_QUIET": "1"}  # Lines on the progress depend on the machine.
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{code}\nended with {done.returncode}:\n{done.stdout}{done.stderr}")
    lines = (done.stdout + done.stderr).splitlines()
    return "\n".join(line.rstrip() for line in lines if not _NOISE.search(line)).strip("\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("page", type=Path)
    parser.add_argument("--check", action="store_true", help="leave the page as it is")
    given = parser.parse_args()
    text = given.page.read_text("utf-8")
    with tempfile.TemporaryDirectory() as folder:

        def renewed(match: re.Match[str]) -> str:
            kind, code, has_output = match.groups()
            output = run_block(kind, code, folder)
            block = f"```{kind}\n{code}```\n"
            if not has_output:
                return block
            return f"{block}\n```text\n{output}\n```\n"

        made = _BLOCK.sub(renewed, text)
    if not given.check:
        given.page.write_text(made, "utf-8")


if __name__ == "__main__":
    main()
