"""Deviations of campaigns against stated uncertainties, judged by what is drawn for many seeds."""

from pathlib import Path

import numpy as np
import pytest
import tomli_w

from twin.scene.campaign import Campaign, Understated, find_understated, list_takes, load_campaign, replace_values
from twin.scene.description import Block

SCALED = {
    "window_tilt_deg": "window_tilt_std_deg",
    "glass_thickness_mm": "glass_thickness_std_mm",
    "glass_index": "glass_index_std",
    "bow_deg": "sheet_bow_std_deg",
    "sheet_thickness": "waist_std",
    "stage_position_mm": "stage_position_std_mm",
    "stage_scale": "stage_lead_std",
    "stage_alignment_deg": "stage_misalignment_std_deg",
    "target_bow_mm": "target_bow_std_mm",
    "target_stretch": "target_stretch_std",
    "temperature_k": "temperature_half_width_c",
}
"""Statement of the sensor, and the imperfection that it covers."""


@pytest.fixture
def campaign(tmp_path: Path) -> Campaign:
    """Return a campaign with a target in water, a step and spheres, whose sensor states its uncertainties."""
    table = {
        "title": "drawn",
        "sensor": "thesis-small",
        "as_built": "thesis-small",
        "recordings": [
            {"name": "target", "scene": "target-through-window", "media": ["water"], "motion": {"count": 3}},
            {"name": "step", "scene": "step"},
            {"name": "spheres", "scene": "spheres"},
        ],
    }
    path = tmp_path / "drawn.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return load_campaign(path)


def find(campaign: Campaign, **imperfections: float) -> list[Understated]:
    drawn = replace_values(campaign, imperfections=imperfections)
    return list(find_understated(drawn, list_takes(drawn, seed=0)))


def test_shipped_campaigns_deviate_by_no_more_than_their_sensor_states():
    for name in ("demo", "detection", "joint", "prediction", "thesis"):
        shipped = load_campaign(name)
        assert not find_understated(shipped, list_takes(shipped, seed=0)), name


@pytest.mark.parametrize("key", SCALED)
def test_only_larger_deviations_than_stated_are_named(campaign: Campaign, key: str):
    rng = np.random.default_rng([58, *key.encode()])
    stated = list_takes(campaign, seed=0)[0].sensor.uncertainty
    std = min(stated.stretch_by_axis()) if key == "target_stretch" else getattr(stated, key)
    # A half width 1.73 times as large as a standard deviation makes a uniform distribution of that standard deviation.
    unit = std * (np.sqrt(3.0) if key == "temperature_k" else 1.0)
    for factor in rng.uniform(0.05, 1.0, 5):
        assert key not in [each.key for each in find(campaign, **{SCALED[key]: factor * unit})], factor
    for factor in rng.uniform(1.3, 20.0, 5):
        (found,) = (each for each in find(campaign, **{SCALED[key]: factor * unit}) if each.key == key)
        assert found.expanded == pytest.approx(2 * std)
        assert found.deviation > found.expanded


@pytest.mark.slow
def test_named_half_widths_contain_95_percent_of_what_is_drawn(campaign: Campaign):
    """Temperatures, step heights and window tilts of 400 seeds: 95 % within 4 standard deviations of the share."""
    half_k, half_mm, tilt_deg, seeds = 7.0, 0.05, 1.0, 400
    sizes = {"temperature_half_width_c": half_k, "step_height_half_width_mm": half_mm, "window_tilt_std_deg": tilt_deg}
    named = {each.key: each for each in find(campaign, **sizes)}
    assert named.keys() == {"temperature_k", "drift_k", "height_uncertainty_mm", "window_tilt_deg"}
    drawn = replace_values(campaign, imperfections=sizes)
    errors: dict[str, list[float]] = {key: [] for key in named}
    for seed in range(seeds):
        target, step, spheres = list_takes(drawn, seed=seed)
        here, later = (take.built.medium("water").temperature_c for take in (target, spheres))
        stated = target.sensor.medium("water").temperature_c
        errors["temperature_k"].append(here - stated)
        errors["drift_k"].append(later - here)
        blocks = [thing for thing in step.scene.objects if isinstance(thing, Block)]
        faces = sorted(thing.position_mm[2] - thing.size_mm[2] / 2 for thing in blocks)
        errors["height_uncertainty_mm"].append(faces[1] - faces[0] - 23.17)
        window = target.built.camera.window, target.sensor.camera.window
        errors["window_tilt_deg"].append(window[0].tilt_x_deg - window[1].tilt_x_deg)
    four = 4 * np.sqrt(0.95 * 0.05 / seeds)
    for key, own in errors.items():
        share = np.mean(np.abs(own) <= named[key].deviation)
        assert abs(share - 0.95) < four, (key, share)


def test_a_sensor_as_built_far_from_its_description_is_named(campaign: Campaign, tmp_path: Path):
    built = tmp_path / "built.toml"
    built.write_text(
        'base = "thesis-small"\n[camera.window]\ndistance_mm = 120.0\n[media.water]\ntemperature_c = 5.0\n',
        encoding="utf-8",
    )
    named = {each.key: each.deviation for each in find(replace_values(campaign, as_built=str(built)))}
    assert named == {"window_distance_mm": pytest.approx(57.2), "temperature_k": pytest.approx(20.0)}


def test_media_of_a_given_index_have_no_temperature(campaign: Campaign, tmp_path: Path):
    measured = tmp_path / "measured.toml"
    measured.write_text('base = "thesis-small"\n[media.water]\nindex = 1.334\n', encoding="utf-8")
    sensors = {"sensor": str(measured), "as_built": str(measured)}
    assert not find(replace_values(campaign, **sensors), temperature_half_width_c=10.0)
