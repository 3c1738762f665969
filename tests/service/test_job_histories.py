"""Jobs in any order of events, against a model: accepted is ended once, whoever was fenced off writes nothing."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, multiple, rule
from live_service import IN_MEMORY
from sqlalchemy import update
from test_leases import Parts

from hsloc_service.auth import ANYBODY
from hsloc_service.db.tables import JobRow
from hsloc_service.errors import ServiceError
from hsloc_service.jobs.repository import JobFilter
from hsloc_service.results.store import Asset

if TYPE_CHECKING:
    from hsloc_service.jobs.leases import Claim

pytestmark = pytest.mark.unmeasured

GRAPH = {
    None: {"queued"},
    "queued": {"running", "cancelled"},
    "running": {"queued", "cancelling", "succeeded", "failed", "crashed"},
    "cancelling": {"cancelled"},
}
"""The ways from state to state that the service's README tells of; from an ended state there is none."""
ENDS = {"succeeded", "failed", "crashed", "cancelled"}
MAX_ATTEMPTS = 3


class Model:
    """What a job should be."""

    def __init__(self) -> None:
        self.state, self.attempt = "queued", 0
        self.holder: Claim | None = None
        self.folder: str | None = None
        self.deleted = False

    def end(self, state: str) -> None:
        self.state = "cancelled" if self.state == "cancelling" else state
        self.holder = None

    def again(self, counts: bool) -> None:
        if counts and self.attempt >= MAX_ATTEMPTS:
            self.end("crashed")
        else:
            self.end("queued")


class Histories(RuleBasedStateMachine):
    """Users, workers, dying servers and the clock, one after the other."""

    jobs, claims = Bundle("jobs"), Bundle("claims")

    def __init__(self) -> None:
        super().__init__()
        self.root = Path(tempfile.mkdtemp(dir=IN_MEMORY))
        self.parts = Parts(self.root)
        self.leases = self.parts.leases(lease_s=1000.0, max_attempts=MAX_ATTEMPTS)
        self.models: dict[str, Model] = {}
        self.checked: dict[str, tuple[object, ...]] = {}
        self.writes = 0

    def teardown(self) -> None:
        self.checked.clear()
        self.the_database_agrees()
        self.parts.database.close()
        self.parts.storage.close()
        shutil.rmtree(self.root)

    def holds(self, claim: Claim) -> Model | None:
        """The claim's job if it still is the claim's."""
        model = self.models[claim.job_id]
        self.checked.pop(claim.job_id, None)
        return model if model.holder == claim else None

    # Users.

    @rule(target=jobs)
    def submit(self) -> str:
        job = self.parts.submit()
        self.models[job] = Model()
        return job

    @rule(target=jobs, old=jobs)
    def rerun(self, old: str) -> Any:
        if self.models[old].deleted:
            with pytest.raises(ServiceError, match="there is no job"):
                self.parts.jobs.rerun(ANYBODY, old, {})
            return multiple()
        job = self.parts.jobs.rerun(ANYBODY, old, self.parts.jobs.get(ANYBODY, old).request).id
        assert job not in self.models
        self.models[job] = Model()
        return job

    @rule(job=jobs)
    def cancel(self, job: str) -> None:
        model = self.models[job]
        self.checked.pop(job, None)
        if model.deleted:
            with pytest.raises(ServiceError, match="there is no job"):
                self.parts.jobs.cancel(ANYBODY, job)
            return
        model.state = {"queued": "cancelled", "running": "cancelling"}.get(model.state, model.state)
        assert self.parts.jobs.cancel(ANYBODY, job).state == model.state

    @rule(job=jobs)
    def delete(self, job: str) -> None:
        model = self.models[job]
        self.checked.pop(job, None)
        if model.deleted or model.state not in ENDS:
            with pytest.raises(ServiceError) as refused:
                self.parts.jobs.delete(ANYBODY, job)
            assert refused.value.status == (404 if model.deleted else 409)
            return
        self.parts.jobs.delete(ANYBODY, job)
        model.deleted = True

    # Workers; a claim may be an old one, of an attempt that somebody else has taken over.

    @rule(target=claims, owner=st.sampled_from("ab"))
    def claim(self, owner: str) -> Any:
        return self.take(owner)

    @rule(target=claims, claim=claims)
    def its_lease_ends_and_the_same_worker_comes_again(self, claim: Claim) -> Any:
        self.a_lease_ends(claim)
        return self.take(claim.owner)

    def take(self, owner: str) -> Any:
        waiting = [job for job, model in self.models.items() if model.state == "queued"]
        claim = self.leases.claim(owner)
        if claim is None:
            assert not waiting
            return multiple()
        assert claim.job_id == waiting[0]  # of one tenant, the oldest comes first
        model = self.models[claim.job_id]
        model.state, model.holder, model.attempt = "running", claim, model.attempt + 1
        assert (claim.owner, claim.attempt) == (owner, model.attempt)
        return claim

    @rule(claim=claims)
    def beat(self, claim: Claim) -> None:
        model = self.holds(claim)
        progress = {"phase": "replay", "done": 1.0, "total": 2.0, "scans": 1, "speed": 1.0}
        beat = self.leases.beat(claim, progress)
        assert beat == ((False, False) if model is None else (True, model.state == "cancelling"))

    @rule(claim=claims)
    def succeed(self, claim: Claim) -> None:
        model = self.holds(claim)
        self.writes += 1
        folder, assets = f"results/{self.writes}", [Asset("a", self.writes, "00", "text/plain")]
        allowed = model is not None and model.state == "running"
        assert self.leases.succeed(claim, folder, assets, {"write": self.writes}) == allowed
        if model is not None and allowed:
            model.end("succeeded")
            model.folder = folder

    @rule(claim=claims, state=st.sampled_from(["failed", "crashed"]))
    def fail(self, claim: Claim, state: str) -> None:
        model = self.holds(claim)
        assert self.leases.fail(claim, state, "x", "x") == (
            None if model is None else "cancelled" if model.state == "cancelling" else state
        )
        if model is not None:
            model.end(state)

    @rule(claim=claims, counts=st.booleans())
    def release(self, claim: Claim, counts: bool) -> None:
        model = self.holds(claim)
        self.leases.release(claim, "x", counts)
        if model is not None:
            model.again(counts)

    # Servers and the clock.

    @rule(claim=claims)
    def a_lease_ends(self, claim: Claim) -> None:
        with self.parts.database.write() as session:
            session.execute(
                update(JobRow).where(JobRow.id == claim.job_id, JobRow.owner.is_not(None)).values(lease_until=0.0)
            )
        model = self.models[claim.job_id]
        assert self.leases.recover() == ([] if model.holder is None else [claim.job_id])
        if model.holder is not None:
            model.again(counts=True)

    @rule(owner=st.sampled_from("ab"))
    def a_server_starts(self, owner: str) -> None:
        lost = {job for job, m in self.models.items() if m.holder is not None and m.holder.owner != owner}
        assert set(self.leases.recover(owner)) == lost
        for job in lost:
            self.models[job].again(counts=True)

    # What holds at any time.

    @invariant()
    def the_database_agrees(self) -> None:
        rows = {row.id: row for row in self.parts.jobs.list(ANYBODY, JobFilter(), limit=1000)}
        assert set(rows) == {job for job, model in self.models.items() if not model.deleted}
        for job, row in rows.items():
            model = self.models[job]
            assert (row.state, row.attempt, row.folder) == (model.state, model.attempt, model.folder)
            assert (row.ended is not None) == (row.state in ENDS)
            assert (row.owner is not None) == (model.holder is not None)
            # The rest of those that nothing was done to is looked at once more at the end.
            if self.checked.get(job) != (found := (row.state, row.attempt, row.folder, row.owner)):
                self.has_its_assets_and_a_way_through_the_graph(job, model)
                self.checked[job] = found

    def has_its_assets_and_a_way_through_the_graph(self, job: str, model: Model) -> None:
        _, assets = self.parts.jobs.assets(ANYBODY, job)
        assert [f"results/{asset.size}" for asset in assets] == ([] if model.folder is None else [model.folder])
        rows = self.parts.jobs.events(ANYBODY, job, 0, limit=1000)[1]
        way = [row.data["state"] for row in rows if row.kind == "state"]
        for before, after in zip([None, *way], way, strict=False):
            assert after in GRAPH.get(before, set()), way
        assert way[-1] == model.state
        assert sum(state in ENDS for state in way) == (model.state in ENDS)


Histories.TestCase.settings = settings(
    max_examples=25,
    stateful_step_count=30,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
TestHistories = Histories.TestCase
