"""The one loop: payload, board, receiver, loads, parameter file, schedule."""
