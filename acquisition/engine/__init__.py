"""The campaign engine: `Campaign` walks a plan; `StopRequest` stops or pauses it; events tell of it."""
