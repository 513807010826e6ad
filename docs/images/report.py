"""Makes the picture of docs/report.md: a run's report from its doubts to its plots, as Chromium shows it.

The run that is shown is of a synthetic mug that leaves the picture and returns; its box is that of
clip/masks/000000.png.

$ tracking3d synth clip --object mug --motion leave_and_return --frames 60 --size 320,240 --seed 3
$ tracking3d run clip/frames --box BOX --out run
$ python docs/images/report.py run/report.html
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from playwright.sync_api import sync_playwright

WIDTH, HEIGHT = 1180, 1000
MARGIN = 28
FRAME = 12
QUALITY = 84


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("report", type=Path, help="the report of a run")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_suffix(".jpg"), help="the picture")
    arguments = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--enable-unsafe-swiftshader"]
        )
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(arguments.report.absolute().as_uri())
        page.focus("#slider")
        for _ in range(FRAME):
            page.keyboard.press("ArrowRight")
        page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
        page.wait_for_timeout(500)
        top = page.locator("#doubt-title").bounding_box()["y"] - MARGIN
        last = page.locator(".scale").last.bounding_box()
        clip = {"x": 0, "y": top, "width": WIDTH, "height": last["y"] + last["height"] + 8 - top}
        page.screenshot(path=arguments.out, type="jpeg", quality=QUALITY, full_page=True, clip=clip)
        browser.close()


if __name__ == "__main__":
    main()
