"""The command line. Whatever is heavy is imported by the command that needs it, so that --help is quick."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from .commands.check import check
from .commands.completion import completion
from .commands.console import EXIT_ERROR, Json, say
from .commands.console import count as _count
from .commands.console import progress as _progress
from .commands.console import say_error as _say_error
from .commands.epi import epi
from .commands.export import export
from .commands.models import models
from .commands.reflow import reflow_help
from .commands.refocus import refocus
from .commands.run import Flag, Masks, run
from .commands.serve import serve
from .commands.source import Source
from .commands.version import version
from .commands.view import view
from .commands.watching import Viewing
from .errors import SeepastError

EXIT_INTERRUPTED, EXIT_PIPE, EXIT_TERMINATED = 130, 141, 143

USAGE = """Usage: seepast COMMAND, for example

  seepast demo                                  a small sample, leaves a picture
  seepast check recording                       are files and calibration fit?
  seepast run recording --out out               the static scene of every frame
  seepast run recordings --out out --masks net  a folder of them, other masks
  seepast run walk.bag --out out --masks none   ROS bag, EuRoC, videos
  seepast run recording --out out --segmenter onnx:people.onnx
  seepast run recording --out out --reference cam2 --preset paper
  seepast run --settings out/run.json --out b   the same run again
  seepast evaluate recording out                how right, where truth is known
  seepast view out                              in the browser; --save out.rrd
  seepast refocus recording --out out --depth 5 plain synthetic aperture
  seepast epi recording --row 200 --out epi.png epipolar-plane image
  seepast export out --to tum                   for SLAM; also bags, PLY, EXR
  seepast serve --rig rig.yaml --masks none     live, from and to ROS 2
  seepast synth made --rig rig.yaml --frames 10 --seed 1
  seepast --version                             backends and extras there are
"""
HELP = "\n\n".join(
    (
        "See past people with a camera array: the static scene's image, disparity and masks of one instant.",
        "A recording is a folder with rig.yaml (Kalibr), cam0/<stamp>.png, cam1/<stamp>.png ... and "
        "masks/cam0/<stamp>.png ... (255 * the probability that a pixel is dynamic); or a ROS bag, an EuRoC folder, "
        "videos cam0.mp4 ..., a Middlebury folder.",
        "Results go to stdout, one line of JSON each with --json; all else goes to stderr.",
        "Exit codes: 0 done; 2 something is wrong with the input or output, told in one line on stderr; "
        "130 interrupted and 143 terminated: what is finished stays, and the same `run` goes on from there; "
        "141 nobody reads stdout any more, as in `seepast --help | head -1`.",
    )
)


app = App(
    name="seepast",
    usage=USAGE,
    help=HELP,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
    version_flags=[],
)

Range = Annotated[tuple[float, float] | None, Parameter(negative=(), show_default=False)]
Backend = Literal["auto", "cpu", "cuda", "reference"]
app.command(run)
app.command(check)
app.command(refocus)
app.command(epi)
app.command(view)
app.command(models)
app.command(completion)
app.command(version, name="--version")
app.command(serve)
app.command(export)


@app.command
def evaluate(
    dataset: Path,
    out: Path,
    /,
    *,
    masks: Masks = None,
    json_: Json = False,
) -> int:
    """Compare what `run` wrote with the truth of the dataset.

    For example

      seepast evaluate made out
      seepast evaluate recordings out --masks masks_network --json

    Parameters
    ----------
    dataset
        Folder with truth/, a Middlebury folder with disp1.png or the like, or a folder of such folders.
    out
        What `run` wrote for it.
    """
    from .datasets import NO_MASKS
    from .evaluate import evaluate, table

    rows = evaluate(dataset, out, None if masks == NO_MASKS else masks or "masks")
    values = {name: {k: None if v != v else v for k, v in row.items()} for name, row in rows.items()}
    say(table(rows), values, json_)
    return 0


@app.command
def synth(
    out: Path,
    /,
    *,
    rig: Path,
    frames: int = 10,
    seed: int = 0,
    masks: Literal["exact", "good", "network", "poor", "all", "none"] = "exact",
    reference: str = "cam0",
    figures: int = 2,
    figure_depth: Range = None,
    background_depth: Range = None,
    noise: float = 1.5,
    gain: float = 0.03,
    grey: Flag = False,
    samples: int = 2,
    json_: Json = False,
) -> int:
    """Make a recording with truth: a room, moving people, lenses.

    For example

      seepast synth made --rig rig.yaml --frames 10 --seed 1
      seepast synth made --rig rig.yaml --masks all --background-depth 4 9

    Parameters
    ----------
    out
        New folder: rig.yaml, cam0/ cam1/ ..., masks/ and truth/.
    rig
        Kalibr file of the array.
    frames
        Number of instants, 0.2 s apart.
    seed
        The same seed and arguments give the same files.
    masks
        How well the people are masked; 'all' makes every kind, in masks_<kind>/.
    reference
        The camera whose rectified view the truth lives in.
    figures
        Number of people.
    figure_depth
        MIN MAX metres from the array; as the array resolves best, if not given.
    background_depth
        MIN MAX metres from the array; as the array resolves best, if not given.
    noise
        Standard deviation at mid-grey, in grey levels.
    gain
        The cameras' gains differ from 1 by at most this.
    grey
        Grey images instead of colour.
    samples
        Each pixel is the mean of samples x samples rays.
    """
    from .synth import generate

    with _progress(out.name, frames) as advance:
        generate(
            out,
            rig,
            frames=frames,
            seed=seed,
            reference=reference,
            masks=masks,
            figures=figures,
            figure_depth=figure_depth,
            background_depth=background_depth,
            noise=noise,
            gain=gain,
            color=not grey,
            samples=samples,
            progress=lambda *_: advance(),
        )
    values = {"name": out.name, "frames": frames, "figures": figures, "seed": seed, "path": str(out)}
    say(f"{out.name}: {_count(frames, 'frame')}, {_count(figures, 'figure')}, seed {seed}, {out}", values, json_)
    return 0


@app.command
def demo(*, out: Path = Path("demo-out"), backend: Backend = "auto", json_: Json = False) -> int:
    """See past the people of a small sample; draw before and after.

    For example

      seepast demo
      seepast demo --out somewhere --backend reference

    The sample comes with seepast.

    Parameters
    ----------
    out
        Output folder: before_after.png, and the output of the run in sample/.
    backend
        auto takes the fastest that works here; reference is the readable NumPy one.
    """
    from .demo import run_demo

    done = run_demo(out, backend)
    milliseconds = done.summary.milliseconds["total"]
    text = (
        f"people hide {100 * done.hidden_share:.1f} % of the view; {100 * done.seen_share:.1f} % of that "
        f"comes back from other cameras, at {done.psnr:.1f} dB, in {milliseconds:.0f} ms"
    )
    picture = str(done.picture.resolve())
    shares = {"hidden_share": done.hidden_share, "seen_share": done.seen_share, "psnr": done.psnr}
    say(f"{text}\n{picture}", {**done.summary.as_dict(), **shares, "picture": picture}, json_)
    return 0


reflow_help(app, Source, Viewing)


class _StderrHandler(logging.Handler):
    """Warnings in one line each, on the stderr of the moment (a progress bar redirects it)."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"seepast: {record.levelname.lower()}: {record.getMessage()}", file=sys.stderr)


class _Terminated(BaseException):
    """SIGTERM, as an exception, so that files in the making are cleaned up."""


def _on_sigterm(*_: object) -> None:
    raise _Terminated


def _leave_stdout() -> int:
    """Nobody reads it any more: what is still to be flushed goes nowhere, so that Python ends in peace."""
    with contextlib.suppress(OSError, ValueError):  # a stdout without a file, as in tests
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    return EXIT_PIPE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command (default: sys.argv) and return its exit code; see HELP."""
    log = logging.getLogger("seepast")
    handler = _StderrHandler(logging.WARNING)
    log.addHandler(handler)
    with contextlib.suppress(ValueError):  # not in the main thread: somebody else handles signals
        signal.signal(signal.SIGTERM, _on_sigterm)
    try:
        tokens = sys.argv[1:] if arguments is None else list(arguments)
        code = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except (BrokenPipeError, SystemExit):  # the second is what rich makes of the first; nothing else here raises it
        return _leave_stdout()
    except (SeepastError, CycloptsError) as error:
        _say_error(error)
        return EXIT_ERROR
    except KeyboardInterrupt:
        _say_error("interrupted; what is finished stays")
        return EXIT_INTERRUPTED
    except _Terminated:
        _say_error("terminated; what is finished stays")
        return EXIT_TERMINATED
    finally:
        log.removeHandler(handler)


if __name__ == "__main__":
    sys.exit(main())
