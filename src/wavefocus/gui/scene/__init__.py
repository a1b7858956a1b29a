"""The Scene tab: draws what is to be felt, and shows what comes of it."""
