"""The campaign engine: `Campaign` walks a plan; `StopRequest` stops or pauses it; events report it."""
