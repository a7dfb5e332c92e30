"""Space packets: primary headers, PUS, CUC times, sequence counts, cutting of a stream, large products."""
