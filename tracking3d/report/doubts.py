"""What limits how far a run can be trusted, in sentences, the most serious first."""

from __future__ import annotations

from tracking3d.estimation.estimate import UNALIGNED_MAP, MaskSource, Status
from tracking3d.results.run_reader import RunReader


def doubts_of(run: RunReader) -> list[str]:
    """Sentences on what in a run is unreliable, and why; empty if nothing is.

    Args:
        run: The run, finished or not.
    """
    return [
        *_about_its_end(run),
        *_about_frames(run),
        *_about_masks(run),
        *_notes(run),
        *_about_pictures(run),
    ]


def _about_its_end(run: RunReader) -> list[str]:
    sentences = []
    if run.state != "finished":
        why = run.description.get("error")
        sentences.append(
            f"The run is {run.state_in_words}{f': {why}' if why else ''}. "
            f"This report shows the {len(run.frames)} frames that were estimated before it stopped."
        )
    refinement = run.description.get("refinement") or {}
    if run.frames and refinement.get("state") not in (None, "finished"):
        reason = refinement.get("reason")
        sentences.append(
            f"The final refinement is {refinement['state']}{f' ({reason})' if reason else ''}. The estimates "
            "are causal: each uses only the frames up to its own."
        )
    return sentences


def _about_frames(run: RunReader) -> list[str]:
    sentences, count = [], len(run.frames)
    diagnostics = [record.diagnostics for record in run.frames if record.status is Status.LOST]
    guessed = sum(UNALIGNED_MAP in terms for terms in diagnostics)
    lost = len(diagnostics) - guessed
    uncertain = sum(record.status is Status.UNCERTAIN for record in run.frames)
    failed = sum(bool(record.failure) for record in run.frames)
    skipped = len(run.description.get("skipped") or [])
    if lost:
        sentences.append(
            f"The object was lost in {_of(lost, count)}: their poses are meaningless, and their masks, if "
            "any, come from the mask tracker."
        )
    if guessed:
        sentences.append(
            f"In {_of(guessed, count)} tracking was re-initialized on a side of the object that had not been "
            "seen before. The pose relative to the earlier map is unknown, so these frames count as lost: "
            "their masks can be used, and their poses are consistent with each other at most."
        )
    if uncertain:
        sentences.append(
            f"{_of(uncertain, count).capitalize()} {_are(uncertain)} uncertain; the pose may be wrong."
        )
    if failed:
        sentences.append(f"A plug-in failed in {_of(failed, count)}.")
    if skipped:
        sentences.append(
            f"{skipped} {'frame was' if skipped == 1 else 'frames were'} skipped: unreadable, of another "
            "size, or dropped to keep up with a camera."
        )
    return sentences


def _about_masks(run: RunReader) -> list[str]:
    sources = [record.mask_source for record in run.frames]
    if not run.frames or None in sources or (run.config.get("object") or {}).get("trust_masks"):
        return []
    if not any(source is not None and source.is_own for source in sources):
        return ["All masks are the mask tracker's, unchanged."]
    handed_back = sum(
        record.mask_source is MaskSource.INITIAL and record.status is not Status.LOST for record in run.frames
    )
    if not handed_back:
        return []
    return [
        f"In {_of(handed_back, len(sources))} that {_are(handed_back)} not lost, the mask is the mask "
        "tracker's, unchanged."
    ]


def _notes(run: RunReader) -> list[str]:
    return [
        f"{text[:1].upper()}{text[1:]}." for note in run.description.get("notes") or [] if (text := str(note))
    ]


def _about_pictures(run: RunReader) -> list[str]:
    revised = sum(record.revision and not record.refined for record in run.frames)
    if not revised:
        return []
    return [
        f"Pictures show the first estimate of each frame. {_of(revised, len(run.frames))} "
        f"{'was' if revised == 1 else 'were'} re-estimated later, and all figures are those of the later "
        "estimate."
    ]


def _of(some: int, count: int) -> str:
    """So many of the frames."""
    if some == count:
        return "the only frame" if count == 1 else f"all {count} frames"
    return f"{some} of {count} frames"


def _are(some: int) -> str:
    return "is" if some == 1 else "are"
