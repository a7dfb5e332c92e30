"""One module per group of commands: parse, build settings, call one function, print."""
