"""Calibration files of stereo rigs, as other programs write them and in our own form."""

ORB_SLAM3 = """%YAML:1.0
File.version: "1.0"
Camera.type: "PinHole"
Camera1.fx: 458.654
Camera1.fy: 457.296
Camera1.cx: 367.215
Camera1.cy: 248.375
Camera1.k1: -0.28340811
Camera1.k2: 0.07395907
Camera1.p1: 0.00019359
Camera1.p2: 1.76187114e-05
Camera2.fx: 457.587
Camera2.fy: 456.134
Camera2.cx: 379.999
Camera2.cy: 255.238
Camera2.k1: -0.28368365
Camera2.k2: 0.07451284
Camera2.p1: -0.00010473
Camera2.p2: -3.55590700e-05
Camera.width: 752
Camera.height: 480
Camera.fps: 20
Stereo.ThDepth: 60.0
Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [0.999997256477797,-0.002317135723275,-0.000343393120620,0.110074137800478,
         0.002312067192432,0.999898048507103,-0.014090668452683,-0.000156612054392,
         0.000376008102320,0.014089835846691,0.999900662638081,0.000889382785432,
         0,0,0,1.000000000000000]
ORBextractor.nFeatures: 1200
"""
"""EuRoC's own calibration in ORB-SLAM3's keys."""


KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [400.0, 401.0, 310.0, 246.0]
  distortion_model: equidistant
  distortion_coeffs: [0.01, -0.02, 0.01, -0.003]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.001]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  intrinsics: [398.0, 396.0, 325.0, 236.0]
  distortion_model: equidistant
  distortion_coeffs: [0.008, -0.015, 0.008, -0.002]
  resolution: [640, 480]
"""


OWN = """
left: {width: 640, height: 480, fx: 420.0, fy: 424, cx: 310, cy: 246, distortion: [-0.28, 0.07, 0.0004, -0.0003]}
right: {width: 640, height: 480, fx: 417.0, fy: 416, cx: 327, cy: 235}
T_left_right: [1, 0, 0, 0, 0.1, 0, 0]
fps: 15
far_depth_baselines: 40
"""
