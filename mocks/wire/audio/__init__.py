"""An emulated audio interface behind JACK and ALSA."""
