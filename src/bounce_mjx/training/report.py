"""The report of a finished training."""

import contextlib
from pathlib import Path

from bounce_mjx.evaluation.results import Report
from bounce_mjx.reports.figures import pixels
from bounce_mjx.reports.page import record_checkpoint, write_report
from bounce_mjx.runs.folders import find_checkpoint
from bounce_mjx.training.log import open_log


def report_training(run: Path, report: Report, steps: int) -> Path:
    """Writes the report of a finished training, and the figure of its final evaluation into the
    TensorBoard log.

    Args:
      report: report of the best checkpoint; in a training of several seeds it has no recording.
      steps: environment steps at the best checkpoint.

    Returns:
      The page's path.

    Raises:
      UserError: the page cannot be written.
    """
    recording = report.recording or record_checkpoint(find_checkpoint(run))
    page, evaluation = write_report(run, recording)
    # A new file, because the log of the training is already closed.
    with contextlib.closing(open_log(run, suffix=".report")) as log:
        log.add_image("evaluation", pixels(evaluation), steps)
    return page
