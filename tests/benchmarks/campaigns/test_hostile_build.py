"""Hostile build against the sandbox: two kinds of attack in the suite, every kind with each profile as campaign."""

import os
import subprocess
import sys

from pytest import mark, param

from benchmarks.campaigns.hostile.attack_kinds import KINDS
from benchmarks.campaigns.hostile_build import _left, campaign, went_well

root_only = mark.skipif(os.geteuid() != 0, reason="the profile can be taken by root only")


def held(result):
    for finding in result.successes:
        print(f"{finding.kind}, {finding.name}: {finding.seen}")
    return went_well(result)


@mark.parametrize("kinds", [("explore", "daemon"), param(KINDS, marks=mark.campaign)])
def test_a_hostile_build_achieves_nothing_as_the_user_of_the_tests(kinds):
    result = campaign("user", kinds)
    assert held(result)
    assert result.attempts > 150 and "private root" in result.isolation


def test_a_process_that_remains_is_of_the_build_that_left_it(tmp_path):
    words = ["-c", "print(flush=True); input()", "x/attack.py", "leftover-12"]
    with subprocess.Popen([sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()  # /proc names its words from here on
        try:
            found = [_left(f"leftover-{number}", tmp_path, tmp_path) for number in (12, 1)]
        finally:
            process.kill()
    assert f"process {process.pid} is alive" in found[0] and found[1] == []


@root_only
@mark.campaign
def test_a_hostile_build_achieves_nothing_with_the_profile_of_the_image():
    assert held(campaign("image", ("explore", "daemon")))


@root_only
def test_a_hostile_build_is_refused_where_the_engine_refuses_namespaces():
    result = campaign("no unshare", ("leave files",))
    assert held(result) and result.refusals == 1
    assert "bubblewrap: No permissions to create new namespace" in result.refusal
    assert "LINNA_RUNNER_EXCHANGE" in result.refusal


@root_only
@mark.parametrize("kinds", [("explore", "daemon"), param(KINDS, marks=mark.campaign)])
def test_a_hostile_build_achieves_nothing_in_the_runner(kinds):
    result = campaign("no unshare, runner", kinds)
    assert held(result) and result.isolation.startswith("runner, bubblewrap")
