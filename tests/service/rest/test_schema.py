"""Whatever the schema of the API allows or forbids, the answer is one that it names."""

from collections import Counter

import pytest
from hypothesis import HealthCheck, Phase, Verbosity, given, seed, settings
from served import serving

from pipeline.service.settings import Settings

schemathesis = pytest.importorskip("schemathesis")

CHECKS = (
    "not_a_server_error",
    "status_code_conformance",
    "content_type_conformance",
    "response_headers_conformance",
    "response_schema_conformance",
    "unsupported_method",
    "allow_header_conformance",
)
"""Left out: acceptance of all that fits the schema, which cannot say which names, cursors and numbers go together."""

UNAVAILABLE = {503, 504}
"""Statuses above 500 that are no defect: theory that takes too long, or is computed for others."""


def asked(client, known, examples, number):
    """Ask for each operation, with names that are stored and with any others; return failures and statuses."""
    from schemathesis import GenerationMode
    from schemathesis.checks import CHECKS as REGISTERED
    from schemathesis.core.failures import FailureGroup

    schema = schemathesis.openapi.from_url(f"http://127.0.0.1:{client.port}/api/v1/openapi.json")
    checks = REGISTERED.get_by_names(list(CHECKS))
    failures, statuses = {}, Counter()
    bounded = settings(
        max_examples=examples, deadline=None, database=None, phases=[Phase.generate], verbosity=Verbosity.quiet,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip

    def ask(case):
        response = case.call(timeout=60)
        statuses[case.operation.label, response.status_code] += 1
        try:
            case.validate_response(response, checks=checks)
        except FailureGroup as group:
            if response.status_code not in UNAVAILABLE:
                failures.update({(case.operation.label, str(each)): response.text[:300] for each in group.exceptions})

    operations = [result.ok() for result in schema.get_all_operations()]
    # what moves and deletes comes last
    for operation in sorted(operations, key=lambda each: each.method.upper() in ("PATCH", "DELETE")):
        names = {name: word for name, word in known.items() if f"{{{name}}}" in operation.label}
        ways = [(GenerationMode.POSITIVE, names or None)]
        if names:
            ways.append((GenerationMode.POSITIVE, None))
        if operation.query or operation.body:
            ways.append((GenerationMode.NEGATIVE, names or None))
        for mode, filled in ways:
            cases = operation.as_strategy(generation_mode=mode, path_parameters=filled)
            seed(number)(bounded(given(case=cases)(lambda case: ask(case))))()
    return failures, statuses


@pytest.mark.parametrize(
    ("examples", "number", "theory_s"),
    [(1, 0, 20.0), (25, 1, 4.0), (25, 2, 4.0)],
)
@pytest.mark.slow
def test_every_answer_is_documented(falcon, tmp_path, examples, number, theory_s, logs):
    with serving(Settings(tmp_path / "processed", tmp_path / "reports", wait_s=0.2, theory_s=theory_s)) as client:
        client.upload(logs)
        job = client.ask("POST", "comparisons", document={"device": "falcon", "criteria": ["overshoot"]}).content
        client.get("experiments/falcon/1/estimates")
        client.all_done()
        trial = client.get("trials?limit=1").content["items"][0]["id"]
        known = {**job, "trial": trial, "device": "falcon", "experiment": "1"}
        failures, statuses = asked(client, known, examples, number)
        assert failures == {}
        answered = {label for label, status in statuses if status < 300}
        # which devices, profiles, places and samples there are, the schema cannot say
        assert len(answered) >= 32
