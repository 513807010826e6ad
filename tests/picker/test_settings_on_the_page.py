"""The picker offers tracker, quality, final mesh, features and lens, in the words of the command line."""

from __future__ import annotations

import pytest
import yaml
from browser import open_page
from raw_requests import request, status
from test_picker_in_browser import drag
from test_picker_server import BOX, body, post, whole

from tracking3d.config.loading import MODELS, QUALITIES
from tracking3d.plugins import FEATURES, TRACKERS, list_plugins


def session_of(picker) -> dict:
    return body(whole(picker, request("GET", "/session.json")))


def test_the_choices_are_those_of_the_command_line(picker_with_settings):
    told = session_of(picker_with_settings)
    choices = told["choices"]
    assert choices["quality"] == list(QUALITIES) and choices["model"] == list(MODELS)
    for group, name in ((TRACKERS, "tracker"), (FEATURES, "features")):
        installed = {
            plugin.name for plugin in list_plugins() if plugin.group == group and plugin.status == "ok"
        }
        assert set(choices[name]) - {"auto"} == installed - {"precomputed"}
    assert "auto" in choices["tracker"]
    assert "an object in a hand" in told["tracker_for"]["segment"]


def test_what_the_command_line_chose_is_chosen_and_what_follows_from_it_is_told(picker_with_settings):
    told = session_of(picker_with_settings)
    assert told["chosen"]["quality"] == "draft" and told["chosen"]["tracker"] is None
    assert told["usual"] == {"tracker": "flow", "model": "none", "features": "rgb"}


def test_what_is_chosen_is_what_the_run_has(picker_with_settings):
    chosen = {"quality": "best", "tracker": "csrt", "model": "none", "fov": 17.9}
    assert body(post(picker_with_settings, "/settings", chosen))["tracker"] == "csrt"
    assert status(post(picker_with_settings, "/start", {"objects": [BOX]})) == 200
    config = picker_with_settings.wait().config
    assert (config.tracker.name, config.crop.size, config.object.texture_views) == ("csrt", 192, 0)
    assert config.camera.fov == 17.9


def test_the_yaml_file_has_it_too(picker_with_settings):
    post(picker_with_settings, "/settings", {"tracker": "csrt", "fov": 30})
    settings = yaml.safe_load(body(post(picker_with_settings, "/save", {"objects": [BOX]}))["settings"])
    assert settings["tracker"]["name"] == "csrt" and settings["camera"]["fov"] == 30


@pytest.mark.parametrize(
    ("chosen", "why"),
    [
        ({"quality": "fine"}, "fine is a value of --model"),
        ({"model": "best"}, "best is a value of --quality"),
        ({"tracker": "cstr"}, "csrt"),
        ({"tracker": "../csrt"}, "no mask tracker"),
        ({"features": "none such"}, "feature encoder"),
        ({"fov": 500}, "camera.fov"),
        ({"fov": "wide"}, "fov"),
        ({"intrinsics": [1, 2, 3]}, "intrinsics"),
        ({"camera": "/etc/passwd"}, "camera"),
        ([], "settings cannot be used"),
    ],
)
def test_what_cannot_be_used_is_told_in_a_sentence_and_changes_nothing(picker_with_settings, chosen, why):
    before = session_of(picker_with_settings)
    answer = post(picker_with_settings, "/settings", chosen)
    assert status(answer) == 422 and why in answer.decode()
    assert session_of(picker_with_settings) == before


def test_where_the_settings_are_fixed_none_are_offered(picker):
    assert session_of(picker)["choices"] is None
    assert status(post(picker, "/settings", {"tracker": "csrt"})) == 422


def test_a_person_chooses_another_tracker_and_another_quality(picker_with_settings):
    with open_page(picker_with_settings.address) as page:
        page.click("#settings summary")
        tracker = page.locator("[data-setting=tracker]")
        assert tracker.locator("option").first.inner_text() == "default (flow)"
        page.select_option("[data-setting=quality]", "good")
        page.wait_for_selector("#source:has-text('tracker auto')")
        assert tracker.locator("option").first.inner_text() == "default (auto)"
        page.select_option("[data-setting=tracker]", "flow")
        page.wait_for_selector("#source:has-text('tracker flow')")
        page.wait_for_selector("#tracker-for:has-text('flow: an object on a turntable')")
        page.fill("[data-setting=fov]", "500")
        page.dispatch_event("[data-setting=fov]", "change")
        page.wait_for_selector("#status.problem:has-text('The settings are as before')")
        assert page.input_value("[data-setting=fov]") == ""
        drag(page, (30, 20), (66, 44))
        page.wait_for_selector("#status:has-text('The run starts from this mask')")
        page.click("#start")
        page.wait_for_selector("#run:not([hidden])")
    config = picker_with_settings.wait().config
    assert (config.tracker.name, config.camera.fov) == ("flow", None)
