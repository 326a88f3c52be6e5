"""Run other people's code in processes of its own, watched and limited.

Here live: starting a process (new, or forked from a server), the seal that keeps it out of folders,
limits on time and memory, and the hand-over of snapshots as files. Nothing here knows what a
process is asked to do: that is a `Session` class, which the parent names and the child imports.
Measuring methods lives in `mor_bench.measure`.

Start reading at `process.SandboxedProcess` (the parent's side), then `child` (the other side).
"""
