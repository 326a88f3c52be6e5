"""Run third-party code in separate processes, watched and limited.

Here live: starting a process, the seal that keeps it out of folders, limits on time and memory, and
the hand-over of snapshots as files. A `Session`
class defines the work of a process; the parent names the class and the child imports it. Measuring
methods lives in `mor_bench.measure`.

Start reading at `process.SandboxedProcess` (the parent's side), then `child` (the other side).
"""
