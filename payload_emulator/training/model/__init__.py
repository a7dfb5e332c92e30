"""The network: architecture, loss, training, calibration, quantisation, export."""
