"""A live session: sources that move while they sound, from orders to the interface."""
