"""The published calibration of run e of the DLR Spatial Cognition data set."""

PUBLISHED_CAM = """\
{ SmRadialDistortedCamera
sensor2Tcp: [ 0.99992, -0.00994383, -0.00778315, -0.0820676 ]
[ 0.00718218, -0.0591054, 0.998226, 0.142944 ]
[ -0.0103862, -0.998202, -0.0590291, 0.0522051 ]
sensor2World: [ -0.99992, 0.00994383, 0.00778315, 0.0179777 ]
[ -0.00211987, 0.475426, -0.879753, -0.0808609 ]
[ -0.0124484, -0.879699, -0.475367, 1.50354 ]
mountIndex: 0
width: 768 height: 288 scaleX: 464.762 scaleY: 232.381 offsetX: 384 offsetY: 144
coef: { -0.0620672 -0.324903 0.314764 1.52524 -0.480806 }
}
"""
