"""The JobSet and the SkyPilot task of `docs/howto/cluster.md` against the models that others have of them."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest
from command_line import REPOSITORY

yaml = pytest.importorskip("yaml")


def manifests() -> list[Any]:
    """What the page shows in YAML: the JobSet, the task."""
    page = (REPOSITORY / "docs" / "howto" / "cluster.md").read_text()
    return [yaml.safe_load(text) for text in re.findall(r"^```yaml\n(.*?)^```", page, re.DOTALL | re.MULTILINE)]


@pytest.mark.slow
def test_the_job_set_numbers_its_pods_as_its_command_says(tmp_path: Path) -> None:
    job_set, _ = manifests()
    (job,) = job_set["spec"]["replicatedJobs"]
    spec = job["template"]["spec"]
    (container,) = spec["template"]["spec"]["containers"]
    number, name = spec["completions"], job_set["metadata"]["name"]
    assert spec["parallelism"] == number
    assert spec["completionMode"] == "Indexed"  # which JOB_COMPLETION_INDEX is of
    meeting = f"--coordinator {name}-{job['name']}-0-0.{name}:1234 --processes {number} --process 1"
    (tmp_path / "python").write_text('#!/bin/sh\necho "$@"')
    (tmp_path / "python").chmod(0o755)
    child = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "JOB_COMPLETION_INDEX": "1"}
    done = subprocess.run(container["command"], env=child, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("train.py balance ")
    assert done.stdout.endswith(f" --distributed {meeting}\n")


@pytest.mark.release
def test_the_job_set_is_one() -> None:
    """Generated from JobSet's OpenAPI; what a model does not know is missing from what it gives back."""
    models = pytest.importorskip("kubeflow_trainer_api.models")
    job_set, _ = manifests()
    assert models.JobsetV1alpha2JobSet.from_dict(job_set).to_dict() == job_set


@pytest.mark.release
def test_the_task_fits_the_schema_of_skypilot() -> None:
    schemas = pytest.importorskip("sky.utils.schemas")
    jsonschema = pytest.importorskip("jsonschema")
    _, task = manifests()
    jsonschema.validate(task, schemas.get_task_schema())
    jsonschema.validate(task["resources"], schemas.get_resources_schema())
