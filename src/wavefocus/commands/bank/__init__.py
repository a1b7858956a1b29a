"""Commands about a bank that is there: checked, estimated, exported, imported, published."""
