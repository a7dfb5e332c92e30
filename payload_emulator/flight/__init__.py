"""Flight software: image preparation, detector, odometry, anchored navigation, telemetry.

Nothing here sees truth, torch, the wall clock or the network. The one door is `payload.Payload.step`.
"""
