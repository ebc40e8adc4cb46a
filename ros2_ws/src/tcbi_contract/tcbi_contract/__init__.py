"""The contract as code: names, limits, QoS and message layouts that every tcbi package shares.

`names` and `errors` are pure; `messages` and `parameters` need rclpy.
"""
