from setuptools import find_packages, setup

setup(
    name="tcbi_dashboard",
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    package_data={"tcbi_dashboard": ["**/*.css", "**/*.js"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/tcbi_dashboard"]),
        ("share/tcbi_dashboard", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    maintainer="The tcbi developers",
    maintainer_email="tcbi@example.org",
    description="The web page: see a model's error, learn what is missing, add it, watch the error fall.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "dashboard_node = tcbi_dashboard.dashboard_node:main",
        ],
    },
)
