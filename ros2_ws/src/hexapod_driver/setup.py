from setuptools import find_packages, setup

setup(
    name="hexapod_driver",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"hexapod_driver": ["**/*.toml", "**/*.json", "**/*.html", "**/*.css", "**/*.js", "**/*.safetensors"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/hexapod_driver"]),
        ("share/hexapod_driver", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="Wire protocols and driver node of a serial hexapod.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "driver_node = hexapod_driver.driver_node:main",
        ],
    },
)
