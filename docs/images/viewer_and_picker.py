"""Makes the pictures of the viewer and of the picker in their documentation, in a headless Chromium.

The clip is of a synthetic bottle; the picker's page is that of a `tracking3d pick` that waits, the viewer's that of a
`tracking3d view` of the run that came of it.

$ tracking3d synth bottle --object bottle --motion turntable --degrees 5 --frames 36 --size 640,480 --seed 5
$ tracking3d pick bottle/frames --out runs/bottle --view
$ python docs/images/viewer_and_picker.py picker http://127.0.0.1:8090/
$ python docs/images/viewer_and_picker.py viewer http://127.0.0.1:8080/
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

BOX = (250, 70, 390, 401)
WIDTH = 640
SIZES = {"picker": (1200, 720), "viewer": (1360, 760)}
ARGUMENTS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
]


def draw_the_box(page: Any) -> None:
    """Say what the bottle is, and start the run once the picture is taken."""
    page.fill("#objects input[type=text]", "bottle")
    area = page.locator("#canvas").bounding_box()
    left, top, right, bottom = (side * area["width"] / WIDTH for side in BOX)
    page.mouse.move(area["x"] + left, area["y"] + top)
    page.mouse.down()
    page.mouse.move(area["x"] + right, area["y"] + bottom, steps=4)
    page.mouse.up()
    page.wait_for_selector("#status:has-text('the run begins with')")


def go_to_the_middle(page: Any) -> None:
    """Show a frame in the middle, without the notice that there is no graphics card."""
    page.wait_for_selector(".timeline")
    page.evaluate("document.querySelector('.mantine-Notification-closeButton')?.click()")
    area = page.locator(".timeline").bounding_box()
    page.mouse.click(area["x"] + 0.62 * area["width"], area["y"] + 60)
    page.wait_for_timeout(5000)


def main() -> None:
    """Take one picture."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=SIZES)
    parser.add_argument("address")
    arguments = parser.parse_args()
    width, height = SIZES[arguments.what]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(arguments.address)
        page.wait_for_timeout(3000)
        (draw_the_box if arguments.what == "picker" else go_to_the_middle)(page)
        page.screenshot(path=Path(__file__).with_name(f"{arguments.what}.jpg"), quality=82, type="jpeg")
        if arguments.what == "picker":
            page.click("#start")
            page.wait_for_selector("#status:has-text('The run has started')")
        browser.close()


if __name__ == "__main__":
    main()
