"""What every tab draws surfaces and plots with."""
