"""The campaign: plan, schedule, engine, events, point quality."""
