"""`dpc segment profile`: what it counts, and whom it refuses."""

from __future__ import annotations


def test_a_profile_names_the_groups_it_knows(dpc_here):
    done = dpc_here("segment", "profile", "--group", "foo")
    assert done.returncode == 2 and b"group = foo: expected one of icosahedral, trivial" in done.stderr
